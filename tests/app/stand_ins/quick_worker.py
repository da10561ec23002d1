"""A worker process whose children run `quick_tasks`."""

if __name__ == "__main__":
    from app.jobs import worker
    from app.sandbox import runner

    runner.TASKS_MODULE = "quick_tasks"
    worker.WARMING = "platform"  # these need no loops
    worker.TIDY_S = 1.0  # type: ignore[misc]  # so that garbage is cleared while a test lasts
    worker.main()
