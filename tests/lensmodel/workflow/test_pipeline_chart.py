"""A corrected chart says how much sharper its edges are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from lensmodel import photo
from lensmodel.core import codec
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, Planes
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto
from lensmodel.simulate import edge_chart
from lensmodel.workflow import correcting

FRAME = Frame(900, 1200)
SMALL = Frame(480, 720)  # large enough for a chart still
NOISE = NoiseModel.white(0.003)


def developed(planes: Planes) -> LinearPhoto:
    return LinearPhoto(
        planes=planes,
        frame=Frame(*planes.shape[1:]),
        noise=(NOISE,) * 3,
        clip=(1.0, 1.0, 1.0),
        info=photo.PhotoInfo("tiff", planes.shape[2], planes.shape[1]),
        encoding=photo.Encoding(),
        pipeline="test",
    )


@pytest.fixture(scope="module")
def model() -> LensModel:
    kernel = gaussian(15, np.eye(2) * 1.7)
    places = [FieldPosition(r, phi) for r in (0.1, 0.5, 0.9) for phi in (-2.0, 0.5, 2.5)]
    return LensModel.fit([PsfSample(kernel, place, photo="x") for place in places])


@pytest.fixture(scope="module")
def measured(model: LensModel) -> LensModel:
    """The same kernels as a target gives them, which are sure of themselves."""
    return LensModel.fit([replace(sample, error=0.05) for sample in model.samples])


@pytest.mark.slow
def test_corrected_chart_has_a_measured_gain_in_each_zone_and_its_part_in_the_zones_of_the_part(
    measured: LensModel,
) -> None:
    scene = ndimage.gaussian_filter(edge_chart(FRAME).scene[1], 1.3)[40:-40, 40:-40]
    noise = np.random.default_rng(1).normal(0.0, 0.003, (3, *scene.shape))
    chart = developed((scene + noise).astype(np.float32))

    whole = correcting.correct_photo(chart, measured, LensSettings(), method="fast")
    part = correcting.correct_photo(chart, measured, LensSettings(), method="fast", roi=(0, 700, 420, 500))

    for report in whole.zones.values():
        assert sum(gain.edges for gain in report.measured) >= 2
        assert all(gain.gain > 1.3 for gain in report.measured)
    assert part.zones["corner"].measured
    for gain in codec.to_json(whole.zones)["corner"]["measured"]:
        assert gain["mtf50_after"] > gain["mtf50_before"]


def test_corrected_photo_without_a_chart_has_no_measured_gain(model: LensModel) -> None:
    rng = np.random.default_rng(2)
    grain = ndimage.gaussian_filter(rng.random((3, SMALL.height, SMALL.width)), (0, 2, 2)).astype(np.float32)

    found = correcting.correct_photo(
        developed(grain), model, LensSettings(), method="fast", roi=(120, 160, 200, 300)
    )

    assert {report.measured for report in found.zones.values()} == {()}
