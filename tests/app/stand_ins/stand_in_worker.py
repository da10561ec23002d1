"""A worker process whose children run the tasks of the module that `LENSMODEL_TASKS` names."""

if __name__ == "__main__":
    import os

    from app.jobs import worker
    from app.sandbox import runner

    runner.TASKS_MODULE = os.environ["LENSMODEL_TASKS"]
    if runner.TASKS_MODULE == "quick_tasks":
        worker.WARMING = "platform"  # these need no loops
        worker.TIDY_S = 1.0  # type: ignore[misc]  # so that garbage is cleared while a test lasts
    worker.main()
