"""A worker process whose children run `light_tasks`."""

if __name__ == "__main__":
    from app.jobs import worker
    from app.sandbox import runner

    runner.TASKS_MODULE = "light_tasks"
    worker.main()
