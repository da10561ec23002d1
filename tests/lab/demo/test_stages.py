"""What the demo says about the time that is left."""

from __future__ import annotations

import pytest

from lab.demo.stages import WEIGHTS, Stages

PLAN = {"first": 60.0, "second": 30.0, "third": 30.0}


class Clocked:
    """Takes what the stages say, under a clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 0.0
        self.left: list[float | None] = []
        self.stages = Stages(lambda _, left: self.left.append(left), PLAN, lambda: self.now)


def test_begins_with_what_it_took_elsewhere() -> None:
    clocked = Clocked()
    clocked.stages.begin("first", "")

    assert clocked.left == [pytest.approx(120.0)]


def test_the_rest_takes_twice_as_long_on_a_machine_half_as_fast() -> None:
    clocked = Clocked()
    clocked.stages.begin("first", "")
    clocked.now = 130.0  # twice the 60 s, and the ten that were believed beforehand
    clocked.stages.begin("second", "")

    assert clocked.left[-1] == pytest.approx(2.0 * 60.0)


def test_half_of_a_stage_counts_half_and_a_smaller_share_takes_nothing_back() -> None:
    clocked = Clocked()
    clocked.stages.begin("first", "")
    clocked.now = 30.0
    clocked.stages.part(0.5, "")
    clocked.stages.part(0.0, "next count")

    assert clocked.left[1:] == [pytest.approx(90.0), pytest.approx(90.0)]


def test_nothing_is_left_at_the_end() -> None:
    clocked = Clocked()
    clocked.stages.finish("")

    assert clocked.left == [None]


def test_every_stage_takes_some_time() -> None:
    assert min(WEIGHTS.values()) > 0
