"""How far the demo is, and how long the rest takes at the speed of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

from app.schemas import JobOut

Tell = Callable[[str, float | None], None]
"""Takes one line of progress, and the seconds that are left, None at the end."""

WEIGHTS: Final[Mapping[str, float]] = {
    "photograph": 30.0,
    "start": 4.0,
    "develop": 4.0,
    "learn 1": 60.0,
    "correct 1": 25.0,
    "learn 2": 60.0,
    "correct 2": 25.0,
    "learn 3": 60.0,
    "correct 3": 25.0,
    "compare": 3.0,
    "correct chart": 12.0,
    "correct": 13.0,
    "refuse a real photo": 4.0,
}
"""Seconds of each stage on a machine of two cores; only their ratios count once some are over."""

_TRUST_S: Final = 10.0
"""Seconds of `WEIGHTS` that are trusted before this machine has shown its own speed (chosen):
the first stages are too short to tell it."""


class Stages:
    """Where the demo stands.

    Parameters
    ----------
    tell : callable
        Called as `tell(text, seconds_left)`.
    weights : mapping of str to float
        Stages in their order, with the seconds that they took elsewhere.
    clock : callable
        Returns seconds.
    """

    def __init__(
        self,
        tell: Tell,
        weights: Mapping[str, float] = WEIGHTS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tell, self._weights, self._clock = tell, dict(weights), clock
        self._began = clock()
        self._stage, self._share = next(iter(weights)), 0.0

    def begin(self, stage: str, text: str) -> None:
        """Say that a stage begins; the ones before it are over."""
        self._stage, self._share = stage, 0.0
        self.say(text)

    def say(self, text: str) -> None:
        """Tell something within the stage."""
        self._tell(text, self.left)

    def part(self, share: float, text: str) -> None:
        """Tell something, and that this share of the stage, 0..1, is over; it never goes back."""
        self._share = max(self._share, min(share, 1.0))
        self.say(text)

    def job(self, text: str, job: JobOut) -> None:
        """Tell how far a job of the service is, which is what the stage waits for."""
        self.part(job.progress.done / job.progress.total if job.progress.total else 0.0, text)

    def finish(self, text: str) -> None:
        """Tell that nothing is left."""
        self._tell(text, None)

    @property
    def left(self) -> float:
        """Seconds that the rest takes, if this machine stays as fast as it was so far."""
        names = list(self._weights)
        at = names.index(self._stage)
        done = sum(self._weights[name] for name in names[:at]) + self._share * self._weights[self._stage]
        pace = (self._clock() - self._began + _TRUST_S) / (done + _TRUST_S)
        return pace * (sum(self._weights.values()) - done)
