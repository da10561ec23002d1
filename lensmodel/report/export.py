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
from typing import Any, Final, TypeAlias

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel
from lensmodel.report.centring import EDGE_R
from lensmodel.report.lens_report import (
    DIRECTIONS,
    UNIT_NAMES,
    ApertureReport,
    LensReport,
    filled_aspect,
    grid,
)

_MOST_BYTES: Final = 1 << 29  # of one file: against questions that fill the memory (chosen)

PsfGrid: TypeAlias = dict[str, Any]
"""Arrays of n = rows * cols places, row by row from the top left: `psf` (n, k, k) float32; `r` in half
diagonals, `phi` in radians counter-clockwise from the right, `error`, the expected relative L2, and
`aperture`, (n,); `shape` (rows, cols); and `channel`."""


def psf_grid(model: LensModel, settings: LensSettings, *, rows: int, cols: int, size: int) -> PsfGrid:
    """Ask a model for the kernels of a grid of places."""
    if 4 * rows * cols * size * size > _MOST_BYTES:
        raise InvalidInputError(
            f"{rows} x {cols} kernels of side {size} are too many; ask for at most {_MOST_BYTES >> 20} MiB"
        )
    places = grid(rows, cols, filled_aspect(model))
    answers = [model.query(place, settings, size) for place in places]
    return {
        "psf": np.array([answer.kernel for answer in answers], np.float32),
        "r": np.array([place.r for place in places]),
        "phi": np.array([place.phi for place in places]),
        "error": np.array([answer.predicted_error for answer in answers]),
        "aperture": np.full(len(places), settings.aperture, np.float64),  # not a number where unknown
        "shape": np.array([rows, cols]),
        "channel": np.array(settings.channel),
    }


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
    cube, (rows, cols) = psfs["psf"][:, ::-1, :], psfs["shape"].tolist()
    primary = fits.PrimaryHDU(np.ascontiguousarray(cube[0] if len(cube) == 1 else cube))
    header = primary.header
    header["ROWORDER"] = ("BOTTOM-UP", "first row stored is the bottom one")
    header["GRIDROWS"], header["GRIDCOLS"] = rows, cols
    header["FILTER"] = (str(psfs["channel"]), "colour channel")
    if math.isfinite(aperture := float(psfs["aperture"][0])):
        header["FNUMBER"] = (aperture, "aperture, f-number")
    header["COMMENT"] = "point spread functions by lensmodel, sum 1"
    columns = [
        fits.Column("R", "D", unit="half-diagonal", array=psfs["r"]),
        fits.Column("PHI", "D", unit="rad", array=psfs["phi"]),
        fits.Column("ERROR", "D", array=psfs["error"]),
    ]
    out = io.BytesIO()
    fits.HDUList([primary, fits.BinTableHDU.from_columns(columns, name="POSITIONS")]).writeto(out)
    return out.getvalue()


def to_npz(psfs: PsfGrid) -> bytes:
    """NumPy archive of the arrays."""
    out = io.BytesIO()
    np.savez_compressed(out, **psfs)
    return out.getvalue()


def to_json(psfs: PsfGrid) -> bytes:
    """JSON: a bare matrix, a list of rows, for a single place, as ART loads it; else an object with units."""
    matrices = [[[float(f"{v:.9g}") for v in row] for row in kernel] for kernel in psfs["psf"]]
    if len(matrices) == 1:
        return json.dumps(matrices[0], allow_nan=False).encode()
    aperture, (rows, cols) = float(psfs["aperture"][0]), psfs["shape"].tolist()
    places = zip(*(psfs[name].tolist() for name in ("r", "phi", "error")), matrices, strict=True)
    content = {
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "aperture": aperture if math.isfinite(aperture) else None,
        "channel": str(psfs["channel"]),
        "rows": rows,
        "cols": cols,
        "psfs": [dict(zip(("r", "phi", "predicted_error", "kernel"), each, strict=True)) for each in places],
    }
    return json.dumps(content, allow_nan=False).encode()


EXPORTERS: Final[Mapping[str, Callable[[PsfGrid], bytes]]] = {"fits": to_fits, "json": to_json, "npz": to_npz}
"""What makes a file of PSFs, by the ending of its name."""


def place_table(report: LensReport) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of tangential and sagittal MTF50 by aperture and place, in each known unit."""
    units = report.sensor.units
    head = ["Aperture", "Place", *(f"{side}, {UNIT_NAMES[unit]}" for unit in units for side in "TS")]
    rows = []
    for found in report.tested:
        for spot in found.spots:
            figures = [words for unit in units for words in spot.figures(report.sensor, unit)]
            place = spot.place + (" (not known)" if spot.unknown else "")
            rows.append([found.at or "unknown", place, *figures])
    return head, rows


_COLUMNS: Final = (
    *("quantity", "aperture", "r", "phi", "frequency_c_px", "direction"),
    *("value", "low", "high", "unit", "predicted_error", "unknown"),
)


def to_csv(report: LensReport) -> str:
    """Write a report as CSV: MTF50 over the picture, contrast by radius, centring."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for found in report.tested:
        for row in _rows(found):
            own = {"aperture": found.settings.aperture, **row}
            writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in own.items()})
    return out.getvalue()


def _rows(found: ApertureReport) -> Iterator[dict[str, Any]]:
    """What was found at one aperture, as figures with what is known of each.

    Centring is the verdict as 0 or 1, and by how much one side is softer, with two standard errors.
    """
    for zone, value in found.zones.items():
        yield {"quantity": f"MTF50, mean of {zone}", "value": value, "unit": "c/px"}
    for spot in (*found.spots, *found.map):
        own = {
            "quantity": f"MTF50 at the {spot.place}" if spot.place else "MTF50",
            "r": spot.position.r,
            "phi": spot.position.phi,
            "unit": "c/px",
            "predicted_error": spot.predicted_error,
            "unknown": int(spot.unknown),
        }
        for direction, value, (low, high) in zip(DIRECTIONS, spot.mtf50, spot.ranges, strict=True):
            yield own | {"direction": direction, "value": value, "low": low, "high": high}
    for curve in found.curves:
        for direction, values in zip(DIRECTIONS, (curve.tangential, curve.sagittal), strict=True):
            own = {"quantity": "MTF", "frequency_c_px": curve.frequency, "direction": direction}
            for r, value in zip(found.radii, values, strict=True):
                yield own | {"r": r, "value": value}
    verdict, softer = found.centring.verdict, found.centring.softer
    yield {
        "quantity": "decentred",
        "value": int(verdict == "decentred"),
        "unknown": int(verdict == "unknown"),
    }
    if softer is not None:
        value, low, high = (math.exp(softer.amount + k * softer.error) for k in (0.0, -2.0, 2.0))
        own = {"quantity": "width of blur, softer side over opposite side", "unit": "ratio", "r": EDGE_R}
        yield own | {"phi": softer.direction, "value": value, "low": low, "high": high}
