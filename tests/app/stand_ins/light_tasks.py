"""The tasks of the service, without the two that cost a processor: for tests that are about the service."""

from __future__ import annotations

import quick_tasks

from app.jobs import tasks

quick_tasks.SECONDS = 0.05

TASKS = tasks.TASKS | {name: quick_tasks.TASKS[name] for name in ("estimate", "measure")}
