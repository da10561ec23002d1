"""A service with secrets in a process of its own, which runs one task: `boxed.py '{"data": "/...", ...}'`."""

import json
import os
import sys
from multiprocessing import forkserver
from pathlib import Path

from app.sandbox import confine, runner
from app.sandbox.account import find
from app.sandbox.child import TaskLimits

if __name__ == "__main__":
    asked = {"user": "none", "module": "hostile_tasks"} | json.loads(sys.argv[1])
    data, account = Path(asked["data"]), find(asked["user"])
    confine.keep_private()
    (data / "app.db").write_text("rows of all owners")
    (data / "blobs").mkdir()
    (data / "blobs" / "other").write_text("a photo of another owner")
    if account:
        for folder in (data, data / "scratch"):
            account.lets_through(folder)
    runner.TASKS_MODULE = asked["module"]
    budget = runner.Budget(1, 1024)
    box = runner.Sandbox(data / "scratch" / "w", budget, cache=data / "cache", account=account)
    with box.folder() as folder, box.folder() as copies:
        own = copies / "own"
        own.write_text("the photo of this task")
        paths = {
            "database": data / "app.db",
            "cache": data / "cache",
            "other": data / "blobs/other",
            "own": own,
        }
        arguments = {name: str(path) for name, path in paths.items()} | {"parent": os.getpid()}
        arguments |= asked.get("arguments", {})
        limits = TaskLimits(1024, 300)
        outcome = box.run(asked["task"], arguments, folder=folder, limits=limits, reads=[own])
    address = forkserver._forkserver._forkserver_address
    print(json.dumps([outcome.ending, outcome.detail, outcome.value, address]))  # noqa: T201
