"""Levenberg and Marquardt's way down a sum of squares: the one loop of all fits of wavefronts.

With the cost c of the unknowns, N half its second derivatives by Gauss and Newton, and g half its first
derivatives, negated, a step s solves ::

    (N + diag(d (diag N + f) + h)) s = g

The damping d rises until a step lowers the cost, and falls after each that does; f keeps unknowns still on
which nothing hangs, and h holds some where they are.

Sources: K. Levenberg, "A method for the solution of certain non-linear problems in least squares", Quarterly
of Applied Mathematics 2, 1944; D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear
parameters", SIAM Journal 11, 1963, whose scale the diagonal is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_FIRST = 1e-2  # of the diagonal: near Gauss and Newton, as Marquardt begins


class Stand(Protocol):
    """Where a descent stands, with all that its next step needs."""

    @property
    def cost(self) -> float:
        """What is minimised."""

    @property
    def normal(self) -> Floats:
        """N above, shape (n, n)."""

    @property
    def gradient(self) -> Floats:
        """Downhill, g above, shape (n,)."""


StandT = TypeVar("StandT", bound=Stand)


def ignore_round(done: int) -> None:
    """Hook that reports nothing."""


@dataclass(frozen=True, slots=True)
class Descent:
    """How boldly to walk, and when to stop.

    Parameters
    ----------
    rounds : int
        Steps taken at most.
    tries : int
        Dampings tried for one step; if none lowers the cost the descent ends.
    enough, enough_of_cost : float
        A step that gains less than the first and the second times the cost ends the descent.
    raised, lowered : float
        Factor on the damping after a try that failed, and what it is divided by after a step.
    floor : float
        f above.
    most_tries : int, optional
        Of all steps together; no bound without it.
    """

    rounds: int
    tries: int
    enough: float = 0.0
    enough_of_cost: float = 0.0
    raised: float = 6.0
    lowered: float = 4.0
    floor: float = 0.0
    most_tries: int | None = None

    def down(
        self,
        stand: StandT,
        moved: Callable[[StandT, Floats], StandT],
        *,
        held: Floats | float = 0.0,
        on_round: Callable[[int], None] = ignore_round,
    ) -> StandT:
        """Walk down.

        Parameters
        ----------
        stand : Stand
            Where to begin.
        moved : callable
            Where a step, shape (n,), leads from a stand; it may shorten or bend it.
        held : ndarray, shape (n,), or float
            h above.
        on_round : callable
            Called with the number of steps taken, after each.

        Returns
        -------
        Stand
            The lowest that was reached; the first one where no step lowers the cost.
        """
        damping, left = _FIRST, self.rounds * self.tries if self.most_tries is None else self.most_tries
        for done in range(self.rounds):
            for _ in range(min(self.tries, left)):
                left -= 1
                diagonal = np.diag(damping * (np.diag(stand.normal) + self.floor) + held)
                step = np.asarray(np.linalg.solve(stand.normal + diagonal, stand.gradient), dtype=np.float64)
                after = moved(stand, step)
                if after.cost < stand.cost:
                    break
                damping *= self.raised
            else:
                break
            enough = self.enough + self.enough_of_cost * stand.cost
            gain, stand = stand.cost - after.cost, after
            damping /= self.lowered
            on_round(done + 1)
            if gain < enough:
                break
        return stand
