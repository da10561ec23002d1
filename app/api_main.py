"""`python -m app.api_main`: one API process."""

if __name__ == "__main__":
    from app.server import main

    main()
