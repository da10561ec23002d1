"""The service and the library learn the same lens from the same file: one path, one result."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from running import running, write_photo

import lensmodel
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.model.profile import read_profile


def asked(model: LensModel) -> np.ndarray:
    """Kernels over the picture in all colours."""
    places = [FieldPosition(r, phi) for r in (0.0, 0.5, 0.9) for phi in (0.3, 2.6, -1.9)]
    return np.array([list(model.kernels(places, LensSettings(2.8, channel=c), 31)) for c in ("r", "g", "b")])


@pytest.mark.parametrize("blank", [0, pytest.param(60, marks=pytest.mark.slow)])
def test_page_and_terminal_learn_one_lens_from_one_file(blank: int, tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "first.dng", 0, blank=blank)
    defaults = {"LENS_PATCHES": "0"}
    with running(tmp_path / "data", **defaults) as service:
        counted = service.calibrated(photo)
        content = service.http.get(f"/v1/lenses/{counted['lens_id']}/profile").content
    page = read_profile(io.BytesIO(content), "the profile of the page").model

    terminal = lensmodel.calibrate([photo], workers=1).model

    assert [s.position for s in page.samples] == [s.position for s in terminal.samples]
    assert [s.estimator for s in page.samples] == [s.estimator for s in terminal.samples]
    apart = np.abs(asked(page) - asked(terminal)).sum(axis=(-2, -1))
    assert apart.max() < 1e-4  # L1 of kernels of sum 1
