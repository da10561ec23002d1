"""`python -m app.runtime.api_main`: one API process."""

if __name__ == "__main__":
    from app.runtime.server import main

    main()
