"""Blind PSFs against stars of the same photo, of a lens that nobody simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.outside import judged
from lensmodel.core.types import LensSettings


@pytest.mark.tools
def test_a_lens_learned_from_a_photo_of_the_sky_has_the_psfs_of_its_stars(shared_data: Path) -> None:
    rows = list(judged(shared_data / "psf" / "starfield_a.tiff", LensSettings(aperture=2.8)))
    assert len(rows) >= 5  # of seven: in one cell stars are not single, in another they do not agree
    blind, point = (np.median([getattr(row, name) for row in rows]) for name in ("distance", "point"))
    assert blind < min(0.25, 0.7 * point)
    assert [row.measured_px for row in rows] == pytest.approx([row.blind_px for row in rows], abs=0.25)
