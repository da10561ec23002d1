"""The regression fed with true kernels of lenses that were not looked at while it was made."""

from __future__ import annotations

import pytest

from lab.model_benchmark import run_model_benchmark


@pytest.mark.slow
def test_true_kernels_are_predicted_between_and_beyond_the_patches() -> None:
    rows = run_model_benchmark(seeds=range(2000, 2016), photos=(1, 2, 5), methods=["mode-default"])
    errors = {row["photos"]: row["errors"] for row in rows}

    assert errors[1]["corner"] <= 0.25
    assert errors[1]["center"] <= 0.15
    assert errors[5]["corner"] <= 0.175
    assert errors[5]["center"] <= 0.06
    for zone in ("center", "mid", "corner"):
        assert errors[1][zone] > errors[2][zone] > errors[5][zone]
