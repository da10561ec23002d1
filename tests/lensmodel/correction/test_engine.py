"""Compiling, which takes a while once on a machine, is told."""

from __future__ import annotations

import logging

import numba
import pytest

from lensmodel.correction import engine


def test_compiling_is_told_once_and_loading_is_not(caplog: pytest.LogCaptureFixture) -> None:
    numba.njit(lambda x: x - 1)(1)  # what listens already has told its line now
    caplog.set_level(logging.INFO, engine.first_use.name)
    caplog.clear()
    engine.tell_of_compiling.cache_clear()  # another test may have asked for it
    engine.tell_of_compiling()
    assert caplog.messages == []

    for number in (1, 1.0):  # compiled for each type anew
        numba.njit(lambda x: x + 1)(number)

    assert len(caplog.messages) == 1
    assert "once on this machine" in caplog.messages[0]
