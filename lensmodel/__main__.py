"""`python -m lensmodel`: the command `lensmodel`, for where its folder is not on the path."""

from lensmodel.cli.main import main

if __name__ == "__main__":
    main()
