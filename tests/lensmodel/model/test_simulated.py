"""The regression fed with true kernels of lenses that were not looked at while it was made."""

from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.psf import distance
from lensmodel.core.types import FieldPosition
from lensmodel.lab.model.model_benchmark import like_estimated, run_model_benchmark
from lensmodel.simulate import draw_lens


@pytest.mark.slow
def test_true_kernels_are_predicted_between_and_beyond_the_patches() -> None:
    methods = ["combined", "mode-wavefront"]
    result = run_model_benchmark(seeds=range(2000, 2016), photos=(1, 2, 5), methods=methods)
    errors, wavefront = (
        {row["photos"]: row["errors"] for row in result["rows"] if row["method"] == name} for name in methods
    )

    for of_method in (errors, wavefront):
        assert of_method[1]["corner"] <= 0.25
        assert of_method[1]["center"] <= 0.15
        assert of_method[5]["corner"] <= 0.16
    assert wavefront[5]["center"] <= 0.04
    assert errors[5]["center"] <= 0.06  # averaged kernels alone
    for zone in ("center", "mid", "corner"):
        assert errors[1][zone] > errors[2][zone] > errors[5][zone]


@pytest.mark.slow
def test_wavefront_with_the_kriged_rest_tells_the_corners() -> None:
    result = run_model_benchmark(seeds=range(1000, 1004), photos=(1, 5), methods=["mode-wavefront"])
    errors = {row["photos"]: row["errors"] for row in result["rows"]}
    worst = {row["photos"]: row["worst"] for row in result["rows"]}

    assert worst[1]["corner"] <= 0.25
    assert worst[1]["center"] <= 0.15
    assert worst[5]["corner"] <= 0.12
    assert worst[5]["center"] <= 0.08
    assert errors[1]["corner"] <= 0.06
    assert errors[1]["center"] <= 0.04
    assert errors[5]["corner"] <= 0.06
    assert errors[5]["center"] <= 0.04
    for zone in ("center", "mid", "corner"):
        assert errors[1][zone] > errors[5][zone]


def test_spoiled_kernels_are_off_by_about_what_was_asked() -> None:
    rng, place = np.random.default_rng(0), FieldPosition(0.5, 0.3)
    true = [draw_lens(seed).kernel(place, None, 31) for seed in range(6)]

    errors = [distance(like_estimated(kernel, rng, 0.35), kernel).rel_l2 for kernel in true for _ in range(5)]

    assert 0.25 < float(np.mean(errors)) < 0.45
