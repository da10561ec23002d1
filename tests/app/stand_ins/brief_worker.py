"""A worker process whose children run `brief_tasks`."""

if __name__ == "__main__":
    from app.jobs import worker
    from app.sandbox import runner

    runner.TASKS_MODULE = "brief_tasks"
    worker.main()
