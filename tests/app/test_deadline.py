"""How long tests wait for other processes."""

from __future__ import annotations

import itertools
import os
from types import SimpleNamespace

import deadline
import pytest


@pytest.mark.parametrize(("load", "within_s"), [(0.0, 200), (500.0, 1800)])
def test_what_never_happens_is_told_however_busy_the_machine(
    load: float, within_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = itertools.count()
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    time = SimpleNamespace(monotonic=lambda: float(next(clock)), sleep=lambda _: None)
    monkeypatch.setattr(deadline, "time", time)

    with pytest.raises(AssertionError, match="never happened"):
        deadline.until(lambda: next(clock) > 10 * within_s)

    assert next(clock) < 2 * within_s
