"""Photos whose pixels a program has turned upright: how they lay on the sensor."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from lab.kernels import gaussian
from lensmodel import photo
from lensmodel.api import _Posteriors
from lensmodel.blind.sampling import find_patches
from lensmodel.core.errors import TurnedPixelsError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelField


def written(path: Path, rows: int, cols: int, tags: dict[int, object]) -> photo.PhotoInfo:
    """A photo with a camera's name, or without."""
    block = Image.Exif()
    block.update(tags)
    noise = np.random.default_rng(0).integers(0, 255, (rows, cols, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, exif=block)
    return photo.inspect(path)


@pytest.mark.parametrize("orientation", [{}, {0x0112: 1}])
def test_what_a_program_turned_is_not_learned_from_and_the_reason_is_said(
    orientation: dict[int, object], tmp_path: Path
) -> None:
    assert written(tmp_path / "x.jpg", 300, 200, {0x0110: "T-1", **orientation}).turned
    developed = photo.develop(tmp_path / "x.jpg")

    assert any("turned its pixels" in remark for remark in developed.remarks)
    with pytest.raises(TurnedPixelsError, match="give the file as the camera wrote it"):
        find_patches(developed, count=4)


@pytest.mark.parametrize(
    ("rows", "cols", "tags"),
    [
        (300, 200, {0x0110: "T-1", 0x0112: 6}),
        (200, 300, {0x0110: "T-1"}),
        (200, 200, {0x0110: "T-1"}),
        (300, 200, {}),
    ],
)
def test_other_photos_lie_as_they_are_stored(
    rows: int, cols: int, tags: dict[int, object], tmp_path: Path
) -> None:
    info = written(tmp_path / "x.jpg", rows, cols, tags)

    assert (info.width, info.height, info.turned) == (cols, rows, False)


def posterior(
    softer_right: float, turns: tuple[int, ...], place: FieldPosition
) -> tuple[NDArray[np.float32], float]:
    samples = [
        PsfSample(
            gaussian(15, np.eye(2) * (1.0 + softer_right * max(math.cos(phi), 0.0))),
            FieldPosition(r, float(phi)),
            LensSettings(aperture=2.0),
            photo=str(photo_number),
        )
        for photo_number in range(3)
        for r in (0.2, 0.5, 0.8)
        for phi in np.linspace(-math.pi, math.pi, 16, endpoint=False)
    ]
    field = ModelField(LensModel.fit(samples, "paper"), LensSettings(aperture=2.0))
    found = _Posteriors(field, turns).posterior_at(place, "g")
    return found.kernel, found.error


def test_of_two_turns_that_may_be_the_mean_is_taken_and_the_error_covers_both() -> None:
    top, right, left = (FieldPosition(0.8, phi) for phi in (math.pi / 2, 0.0, math.pi))

    alike, error_alike = posterior(0.0, (1, 3), top)
    mean, error = posterior(3.0, (1, 3), top)
    sides = [posterior(3.0, (0,), place) for place in (right, left)]

    single, error_single = posterior(0.0, (0,), top)
    assert alike == pytest.approx(single, abs=1e-3)  # where all sides are alike, nothing is lost
    assert error_alike == pytest.approx(error_single, abs=0.02)
    side = max(kernel.shape[0] for kernel, _ in sides)
    padded = [np.pad(kernel, (side - kernel.shape[0]) // 2) for kernel, _ in sides]
    distance = np.linalg.norm(padded[0] - padded[1]) / 2.0 / np.linalg.norm(mean)
    assert error >= distance > 0.2
