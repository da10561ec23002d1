"""Figures of a report as tables, and PSFs in the formats of other programs.

All kernels are the image of a point in sensor orientation, row 0 at the top, sum 1, centre of mass on
the middle pixel: what a program convolves with to blur, and is to be given to undo it.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel
from lensmodel.report.centring import EDGE_R
from lensmodel.report.lens_report import DEFAULT_ASPECT, UNIT_NAMES, ApertureReport, LensReport, Spot, grid

_HEAD: Final = (
    *("quantity", "aperture", "channel", "r", "phi", "row", "col", "frequency_c_px", "frequency_lp_mm"),
    *("direction", "value", "low", "high", "unit", "predicted_error", "unknown"),
)
_Row: TypeAlias = dict[str, str | float | None]
_MOST_BYTES: Final = 1 << 29  # of one file: against questions that fill the memory (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PsfGrid:
    """Kernels at n = rows * cols places, row by row from the top left."""

    kernels: NDArray[np.float32]  # (n, k, k)
    r: NDArray[np.float64]  # (n,), half-diagonals
    phi: NDArray[np.float64]  # (n,), radians, counter-clockwise from the right
    predicted_error: NDArray[np.float64]  # (n,), expected relative L2 of each kernel
    rows: int
    cols: int
    settings: LensSettings


def psf_grid(
    model: LensModel,
    settings: LensSettings,
    *,
    rows: int = 5,
    cols: int = 7,
    size: int = 31,
    aspect: float = DEFAULT_ASPECT,
) -> PsfGrid:
    """Ask a model for the kernels of a grid of places."""
    if size < 1 or 4 * rows * cols * size * size > _MOST_BYTES:
        raise InvalidInputError(
            f"{rows} x {cols} kernels of side {size} are out of range; "
            f"ask for at most {_MOST_BYTES >> 20} MiB"
        )
    places = grid(rows, cols, aspect)
    answers = [model.query(place, settings, size) for place in places]
    return PsfGrid(
        kernels=np.array([answer.kernel for answer in answers], dtype=np.float32),
        r=np.array([place.r for place in places]),
        phi=np.array([place.phi for place in places]),
        predicted_error=np.array([answer.predicted_error for answer in answers]),
        rows=rows,
        cols=cols,
        settings=settings,
    )


def to_fits(psfs: PsfGrid) -> bytes:
    """FITS, 32-bit float: a cube (place, row, col), or an image for a single place, as Siril loads it.

    Rows are stored from the bottom, as is the custom of the format, and ROWORDER says so. The extension
    POSITIONS lists r, phi (radians, counter-clockwise from the right) and the expected error. Source:
    "Definition of the Flexible Image Transport System", version 4.0, 2018, sec. 3.3 and 7.3.
    """
    try:  # imported when it is wanted: most people never write FITS, and it takes half a second
        fits = importlib.import_module("astropy.io.fits")
    except ImportError as error:
        raise InvalidInputError(
            "writing FITS needs astropy; install it with `pip install '.[fits]'` in this program's folder, "
            "or export npz instead"
        ) from error
    cube = psfs.kernels[:, ::-1, :]
    primary = fits.PrimaryHDU(np.ascontiguousarray(cube[0] if len(cube) == 1 else cube))
    header = primary.header
    header["ROWORDER"] = ("BOTTOM-UP", "first row stored is the bottom one")
    header["GRIDROWS"], header["GRIDCOLS"] = psfs.rows, psfs.cols
    header["FILTER"] = (psfs.settings.channel, "colour channel")
    if psfs.settings.aperture is not None:
        header["FNUMBER"] = (psfs.settings.aperture, "aperture, f-number")
    if psfs.settings.focal_mm is not None:
        header["FOCALLEN"] = (psfs.settings.focal_mm, "focal length, mm")
    header["COMMENT"] = "point spread functions by lensmodel, sum 1"
    columns = [
        fits.Column("R", "D", unit="half-diagonal", array=psfs.r),
        fits.Column("PHI", "D", unit="rad", array=psfs.phi),
        fits.Column("ERROR", "D", array=psfs.predicted_error),
    ]
    out = io.BytesIO()
    fits.HDUList([primary, fits.BinTableHDU.from_columns(columns, name="POSITIONS")]).writeto(out)
    return out.getvalue()


def to_npz(psfs: PsfGrid) -> bytes:
    """NumPy archive with `psf` (n, k, k), `shape` (rows, cols), and r, phi, error of each place."""
    out = io.BytesIO()
    aperture = math.nan if psfs.settings.aperture is None else psfs.settings.aperture
    np.savez_compressed(
        out,
        psf=psfs.kernels,
        r=psfs.r,
        phi=psfs.phi,
        error=psfs.predicted_error,
        shape=np.array([psfs.rows, psfs.cols]),
        aperture=np.full(len(psfs.r), aperture),
        channel=np.array(psfs.settings.channel),
    )
    return out.getvalue()


def to_json(psfs: PsfGrid) -> bytes:
    """JSON: a bare matrix, a list of rows, for a single place, as ART loads it; else an object with units."""
    matrices = [[[float(f"{v:.9g}") for v in row] for row in kernel] for kernel in psfs.kernels]
    if len(matrices) == 1:
        return json.dumps(matrices[0], allow_nan=False).encode()
    places = zip(psfs.r.tolist(), psfs.phi.tolist(), psfs.predicted_error.tolist(), matrices, strict=True)
    content = {
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "aperture": psfs.settings.aperture,
        "focal_mm": psfs.settings.focal_mm,
        "channel": psfs.settings.channel,
        "rows": psfs.rows,
        "cols": psfs.cols,
        "psfs": [dict(zip(("r", "phi", "predicted_error", "kernel"), each, strict=True)) for each in places],
    }
    return json.dumps(content, allow_nan=False).encode()


EXPORTERS: Final[Mapping[str, Callable[[PsfGrid], bytes]]] = {"fits": to_fits, "json": to_json, "npz": to_npz}
"""What makes a file of PSFs, by the ending of its name."""


def place_table(report: LensReport) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of tangential and sagittal MTF50 by aperture and place, in each known unit."""
    words, units = report.sensor.words, report.sensor.units
    head = ["Aperture", "Place", *(f"{side}, {UNIT_NAMES[unit]}" for unit in units for side in "TS")]
    rows = []
    for found in report.tested:
        for spot in (found.spots[0], *found.sides, *found.spots[1:]):
            place = spot.place.removeprefix("the ") + (" (not known)" if spot.unknown else "")
            figures = [words(value, unit, between) for unit in units for _, value, between in spot.directions]
            rows.append([found.at or "unknown", place, *figures])
    return head, rows


def to_csv(report: LensReport) -> str:
    """Write a report as CSV: MTF50 over the picture, contrast by radius, centring."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for row in (row for found in report.tested for row in _rows(found)):
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return out.getvalue()


def _rows(found: ApertureReport) -> Iterator[_Row]:
    """What was found at one aperture, as figures with what is known of each.

    Centring is the verdict as 0 or 1, and both signs of a fault with two standard errors and their direction.
    """
    known: _Row = {"aperture": found.settings.aperture, "channel": found.settings.channel}
    for zone, value in found.zones.items():
        yield known | {"quantity": f"MTF50, mean of {zone}", "value": value, "unit": "c/px"}
    cells = [(divmod(i, found.cols), spot) for i, spot in enumerate(found.map)]
    spots: list[tuple[_Row, Spot]]
    spots = [({"quantity": f"MTF50 at {s.place}"}, s) for s in (*found.spots, *found.sides)]
    spots += [({"quantity": "MTF50", "row": row, "col": col}, s) for (row, col), s in cells]
    for own, spot in spots:
        own |= {"r": spot.position.r, "phi": spot.position.phi, "unit": "c/px", "unknown": int(spot.unknown)}
        own |= {"predicted_error": spot.predicted_error}
        for direction, value, (low, high) in spot.directions:
            yield known | own | {"direction": direction, "value": value, "low": low, "high": high}
    for curve in found.curves:
        own = {"quantity": "MTF", "frequency_c_px": curve.frequency, "frequency_lp_mm": curve.lp_mm}
        for direction, values in (("tangential", curve.tangential), ("sagittal", curve.sagittal)):
            for r, value in zip(found.radii, values, strict=True):
                yield known | own | {"direction": direction, "r": r, "value": value}
    centring = found.centring
    own = {"value": int(centring.verdict == "decentred"), "unknown": int(centring.verdict == "unknown")}
    yield known | {"quantity": "decentred"} | own
    for sign, quantity, unit, r in (
        (centring.softer, "width of blur, softer side over opposite side", "ratio", EDGE_R),
        (centring.coma, "coma in the middle of the picture", "cubed widths of blur", 0.0),
    ):
        if sign is not None:
            ends = (sign.amount + k * sign.error for k in (0.0, -2.0, 2.0))
            value, low, high = (math.exp(end) if unit == "ratio" else max(end, 0.0) for end in ends)
            own = {"quantity": quantity, "unit": unit, "r": r, "phi": sign.direction}
            yield known | own | {"value": value, "low": low, "high": high}
