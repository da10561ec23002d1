"""How far a reproduction is: what is done, of how much."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

from lab.reproduce.cases import HARD_METHODS, Case, Reproduction
from lab.reproduce.conditions import BASE


class OnWork(Protocol):
    """Hears of progress; weights are rough shares of the time."""

    def __call__(self, words: str, done: float, total: float, *, fresh: bool) -> None:
        """Say that `done` of `total` is over, and whether the last part was computed or found stored."""


@dataclass(slots=True)
class Progress:
    """Adds up the weights of what is done and tells a listener."""

    on_work: OnWork
    total: float
    done: float = 0.0

    def tell(self, words: str, weight: float, *, fresh: bool = True) -> None:
        """Say that one more piece of work is over."""
        self.done += weight
        self.on_work(words, self.done, self.total, fresh=fresh)


SHOT: Final = 1.0
LEARN: Final = 5.0
CORRECT: Final = 1.0
MEASURE: Final = 4.0
RIVAL: Final = 4.0
PROGRAM: Final = 4.0
PAPER_LEARN: Final = 20.0
PAPER_CORRECT: Final = 2.0
FIGURES: Final = 12.0
"""Rough shares of the time, that of a photo taken is 1 (chosen): only the bar of progress needs them."""


def methods_of(case: Case, plan: Reproduction) -> tuple[str, ...]:
    """Non-blind methods that a case is corrected by."""
    return plan.methods if case.condition == BASE else HARD_METHODS


def rivals_of(case: Case, plan: Reproduction) -> tuple[str, ...]:
    """Rivals of a case; one of n = 10, 20 is a lens that another case has from its first photo on."""
    return plan.rivals if is_whole(case) else ()


def programs_of(case: Case, plan: Reproduction) -> tuple[str, ...]:
    """Programs of others that correct what a case photographs; like the rivals, each lens once."""
    return plan.programs if rivals_of(case, plan) else ()


def is_whole(case: Case) -> bool:
    """Whether a case is that of a lens from its first photo on, which is compared with most: one for each."""
    return case.condition == BASE and case.photos[0] <= 2


def with_target(case: Case, plan: Reproduction) -> bool:
    """Whether the lens of a case is also measured with a target."""
    return plan.target and is_whole(case)


def with_general(case: Case, plan: Reproduction) -> bool:
    """Whether a general profile of the lens model is compared with."""
    return plan.general and is_whole(case)


def with_paper(case: Case, plan: Reproduction) -> bool:
    """Whether the lens of a case is also learned the paper's own way: once, like the rivals."""
    return plan.paper and is_whole(case)


def corrections(case: Case, plan: Reproduction) -> float:
    """Weight of correcting and measuring chart and photo by every method."""
    return (2 if case.conditions.with_chart else 1) * len(methods_of(case, plan)) * CORRECT


def weight_of(case: Case, plan: Reproduction) -> float:
    """Weight of a whole case."""
    shots = (case.photos[-1] + 2) * SHOT
    each = corrections(case, plan)
    target = (MEASURE + each) * (with_target(case, plan) + with_general(case, plan))
    if with_paper(case, plan):
        target += case.photos[-1] * PAPER_LEARN + len(case.photos) * PAPER_CORRECT
    rest = target + len(rivals_of(case, plan)) * (RIVAL + each) + len(programs_of(case, plan)) * PROGRAM
    return shots + each + 2 * CORRECT + case.photos[-1] * LEARN + len(case.photos) * each + rest
