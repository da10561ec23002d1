"""Tasks that misbehave, where the kernel has no measure at all."""

from __future__ import annotations

from hostile_tasks import TASKS

from app.sandbox import confine

__all__ = ["TASKS"]

confine.confine = lambda *_: None
