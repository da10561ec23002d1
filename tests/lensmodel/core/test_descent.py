"""The way down a sum of squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from lensmodel.core.descent import Descent, Floats

A = np.array([[2.0, 0.5, 0.0], [0.0, 1.0, -0.4], [0.3, 0.0, 1.5], [1.0, 1.0, 1.0]])
B = np.array([1.0, -2.0, 0.5, 3.0])
BEST = np.linalg.lstsq(A, B, rcond=None)[0]


@dataclass(frozen=True)
class Line:
    """|A x - B|^2 about some x."""

    x: Floats

    @property
    def cost(self) -> float:
        return float(((A @ self.x - B) ** 2).sum())

    @property
    def normal(self) -> Floats:
        return A.T @ A

    @property
    def gradient(self) -> Floats:
        return A.T @ (B - A @ self.x)


def moved(line: Line, step: Floats) -> Line:
    return Line(line.x + step)


def test_a_linear_problem_ends_at_its_least_squares() -> None:
    found = Descent(rounds=20, tries=3).down(Line(np.zeros(3)), moved)

    assert found.x == pytest.approx(BEST, abs=1e-9)


def test_an_unknown_that_is_held_stays() -> None:
    found = Descent(rounds=20, tries=3).down(Line(np.zeros(3)), moved, held=np.array([0.0, 1e12, 0.0]))

    assert found.x[1] == pytest.approx(0.0, abs=1e-9)
    others = np.linalg.lstsq(A[:, [0, 2]], B, rcond=None)[0]
    assert found.x[[0, 2]] == pytest.approx(others, abs=1e-9)


def test_no_step_is_taken_that_raises_the_cost() -> None:
    asked = []

    def uphill(line: Line, step: Floats) -> Line:
        asked.append(float(np.abs(step).max()))
        return Line(line.x - step)

    begin = Line(np.zeros(3))
    assert Descent(rounds=5, tries=4).down(begin, uphill) is begin
    assert len(asked) == 4
    assert asked == sorted(asked, reverse=True)  # more damping, shorter steps


def test_tries_of_all_steps_together_have_a_bound() -> None:
    rounds: list[int] = []
    Descent(rounds=9, tries=9, most_tries=2).down(Line(np.zeros(3)), moved, on_round=rounds.append)

    assert rounds == [1, 2]


def test_a_step_that_gains_little_is_the_last_one() -> None:
    rounds: list[int] = []
    Descent(rounds=9, tries=9, enough=1e6).down(Line(np.zeros(3)), moved, on_round=rounds.append)
    assert rounds == [1]

    Descent(rounds=9, tries=9, enough_of_cost=1.0).down(Line(np.zeros(3)), moved, on_round=rounds.append)
    assert rounds == [1, 1]


def test_a_floor_keeps_an_unknown_still_on_which_nothing_hangs() -> None:
    @dataclass(frozen=True)
    class Blind(Line):
        @property
        def normal(self) -> Floats:
            normal: Floats = np.diag([1.0, 1.0, 0.0])
            return normal

        @property
        def gradient(self) -> Floats:
            return np.array([1.0, 1.0, 0.0]) * (BEST - self.x)

        @property
        def cost(self) -> float:
            return float(((self.x - BEST)[:2] ** 2).sum())

    found = Descent(rounds=20, tries=2, floor=1e-9).down(
        Blind(np.zeros(3)), lambda at, step: Blind(at.x + step)
    )

    assert found.x == pytest.approx([*BEST[:2], 0.0], abs=1e-6)
