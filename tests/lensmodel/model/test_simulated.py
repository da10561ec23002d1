"""The regression fed with true kernels of lenses that were not looked at while it was made."""

from __future__ import annotations

import numpy as np
import pytest

from lab.model.model_benchmark import like_estimated, run_model_benchmark
from lensmodel.core.psf import distance
from lensmodel.core.types import FieldPosition
from lensmodel.simulate import draw_lens


@pytest.mark.slow
def test_true_kernels_are_predicted_between_and_beyond_the_patches() -> None:
    result = run_model_benchmark(seeds=range(2000, 2016), photos=(1, 2, 5), methods=["combined"])
    errors = {row["photos"]: row["errors"] for row in result["rows"]}

    assert errors[1]["corner"] <= 0.25
    assert errors[1]["center"] <= 0.15
    assert errors[5]["corner"] <= 0.16
    assert errors[5]["center"] <= 0.06
    for zone in ("center", "mid", "corner"):
        assert errors[1][zone] > errors[2][zone] > errors[5][zone]


def test_spoiled_kernels_are_off_by_about_what_was_asked() -> None:
    rng, place = np.random.default_rng(0), FieldPosition(0.5, 0.3)
    true = [draw_lens(seed).kernel(place, None, 31) for seed in range(6)]

    errors = [distance(like_estimated(kernel, rng, 0.35), kernel).rel_l2 for kernel in true for _ in range(5)]

    assert 0.25 < float(np.mean(errors)) < 0.45
