"""`python -m app.runtime.worker_main`: kept this small because every child process imports it again."""

if __name__ == "__main__":
    from app.jobs.worker import main

    main()
