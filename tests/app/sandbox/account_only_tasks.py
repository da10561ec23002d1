"""Tasks that misbehave, where the kernel has no measure but another account."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hostile_tasks import TASKS

from app.sandbox import confine
from app.sandbox.account import SystemAccount

__all__ = ["TASKS"]


def _only_account(folder: Path, reads: Iterable[Path] = (), account: SystemAccount | None = None) -> None:
    assert account is not None
    confine.become(account)


confine.confine = _only_account
