"""What is exported reads back as the same PSFs, upright and at their places."""

from __future__ import annotations

import importlib
import io
import json
import math
import sys
from typing import Literal

import numpy as np
import pytest

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, centroid
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.report.export import EXPORTERS, PsfGrid, psf_grid
from lensmodel.simulate import draw_lens

SETTINGS = LensSettings(aperture=2.0)


@pytest.fixture(scope="module")
def model() -> LensModel:
    lens = draw_lens(1000, "coma")
    settings = LensSettings(aperture=max(2.0, lens.optics[0].f_number))
    places = [FieldPosition(r, a + r) for r in (0.1, 0.4, 0.6, 0.9) for a in np.arange(6) * math.pi / 3]
    return LensModel.fit([PsfSample(lens.kernel(p, settings, 15), p, settings, photo="a") for p in places])


@pytest.fixture(scope="module")
def psfs(model: LensModel) -> PsfGrid:
    return psf_grid(model, SETTINGS, rows=2, cols=3, size=15)


def arrow() -> PsfGrid:
    """One kernel with its light above and to the right: a flipped axis shows."""
    kernel = np.zeros((1, 5, 5), dtype=np.float32)
    kernel[0, 0, 2], kernel[0, 2, 4] = 0.75, 0.25
    places = dict(zip(("r", "phi", "error", "aperture"), np.array([[0.5], [1.0], [0.1], [2.0]]), strict=True))
    return {"psf": kernel, **places, "shape": np.array([1, 1]), "channel": np.array("g")}


def test_a_grid_asks_the_model_at_each_place(model: LensModel, psfs: PsfGrid) -> None:
    assert psfs["psf"].shape == (6, 15, 15)
    for r, phi, kernel in zip(psfs["r"], psfs["phi"], psfs["psf"], strict=True):
        assert kernel == pytest.approx(model.query(FieldPosition(r, phi), SETTINGS, 15).kernel, abs=1e-7)


def test_fits_is_a_cube_stored_from_the_bottom_with_a_table_of_places(psfs: PsfGrid) -> None:
    fits = importlib.import_module("astropy.io.fits")
    with fits.open(io.BytesIO(EXPORTERS["fits"](psfs))) as file:
        cube, header = file[0].data, file[0].header
        table = file["POSITIONS"].data
        assert np.array_equal(cube[:, ::-1], psfs["psf"])
        assert header["BITPIX"] == -32
        assert header["ROWORDER"] == "BOTTOM-UP"
        assert header["FNUMBER"] == 2.0
        assert table["R"].tolist() == psfs["r"].tolist()
        assert table["PHI"].tolist() == psfs["phi"].tolist()


@pytest.mark.parametrize("form", ["fits", "json"])
def test_a_single_place_is_a_bare_matrix_with_the_top_row_last_in_fits_and_first_in_json(
    form: Literal["fits", "json"],
) -> None:
    written = EXPORTERS[form](arrow())

    if form == "fits":
        stored = importlib.import_module("astropy.io.fits").getdata(io.BytesIO(written))[::-1]
    else:
        stored = np.array(json.loads(written))
    assert stored.shape == (5, 5)
    assert (stored[0, 2], stored[2, 4]) == (0.75, 0.25)


def test_fits_without_astropy_names_the_remedy(psfs: PsfGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "astropy.io.fits", None)

    with pytest.raises(InvalidInputError, match=r"pip install '\.\[fits\]'"):
        EXPORTERS["fits"](psfs)


def test_npz_holds_kernels_and_places_without_pickle(psfs: PsfGrid) -> None:
    with np.load(io.BytesIO(EXPORTERS["npz"](psfs)), allow_pickle=False) as stored:
        assert np.array_equal(stored["psf"], psfs["psf"])
        assert stored["r"].tolist() == psfs["r"].tolist()
        assert stored["phi"].tolist() == psfs["phi"].tolist()
        assert stored["shape"].tolist() == [2, 3]
        assert set(stored["aperture"]) == {2.0}


def test_json_of_a_grid_holds_every_kernel_to_the_last_bit(psfs: PsfGrid) -> None:
    stored = json.loads(EXPORTERS["json"](psfs))
    kernels = np.array([entry["kernel"] for entry in stored["psfs"]], dtype=np.float32)
    assert np.array_equal(kernels, psfs["psf"])
    assert (stored["rows"], stored["cols"], stored["aperture"]) == (2, 3, 2.0)


def test_a_single_place_is_the_middle(model: LensModel) -> None:
    one = psf_grid(model, SETTINGS, rows=1, cols=1, size=15)

    assert one["r"].tolist() == [0.0]
    assert np.hypot(*centroid(one["psf"][0].astype(np.float64))) < 2e-3


def test_grids_too_large_for_memory_are_refused(model: LensModel) -> None:
    with pytest.raises(InvalidInputError, match="512 MiB"):
        psf_grid(model, SETTINGS, rows=100, cols=100, size=255)
