"""The chart of slanted edges: dark squares on a page, all turned by five degrees, as a drawing in a PDF file.

Squares are drawn as shapes, not as pixels: a printer draws their edges as finely as it can. They are black,
since printers make greys of dots, which a photo would show along the edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically
from lensmodel.measured.page import require_paper

ROWS: Final = 5
COLS: Final = 7
LEAN_DEG: Final = 5.0
_FILL: Final = (
    0.6  # side of a square over the distance of two (chosen: a crop on each edge holds flat ground)
)
_MARGIN_MM: Final = 7.0  # of white around the squares: printers leave up to 6 mm (chosen)
_POINTS: Final = 72.0 / 25.4  # of PDF, a millimetre


def chart_squares(width: float, height: float, margin: float) -> NDArray[np.float64]:
    """Return the corners (35, 4, 2) of the squares on a page as (x, y), y upwards, in the unit of the page.

    The outermost touch the margin.
    """
    c, s = math.cos(math.radians(LEAN_DEG)), math.sin(math.radians(LEAN_DEG))
    right, up = (COLS - 1) / 2.0, (ROWS - 1) / 2.0
    reach = np.array([right * c + up * s, up * c + right * s]) + _FILL / 2.0 * (c + s)
    spacing = float(np.min((np.array([width, height]) / 2.0 - margin) / reach))
    j, i = np.meshgrid(np.arange(COLS) - right, up - np.arange(ROWS))
    middles = np.stack([j, i], axis=-1).reshape(-1, 1, 2)
    corners = _FILL / 2.0 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    turned = (middles + corners) @ np.array([[c, s], [-s, c]])
    return np.asarray(turned * spacing + (width / 2.0, height / 2.0))


def print_chart(path: str | Path, *, paper: str = "a3") -> None:
    """Write the chart to print on a paper of `PAPERS`, as a PDF file."""
    path = Path(path)
    width, height = (side * _POINTS for side in require_paper(paper))
    if path.suffix.lower() != ".pdf":
        raise InvalidInputError(f"{path.name}: a chart of edges is written as .pdf")
    name = f"lensmodel edges, {paper.upper()}"
    shapes = [
        " l ".join(f"{x:.3f} {y:.3f}" for x, y in square).replace(" l ", " m ", 1) + " l h f"
        for square in chart_squares(width, height, _MARGIN_MM * _POINTS)
    ]
    # turned counter-clockwise, the squares leave room below on the right
    words = f"BT /F 7 Tf {0.6 * width:.0f} 8 Td ({name}: print at full size, black, on matte paper) Tj ET"
    write_atomically(path, _pdf("\n".join([*shapes, words]), (width, height), name))


def _pdf(drawing: str, size: Sequence[float], title: str) -> bytes:
    """Wrap a drawing of one page (ISO 32000-1:2008, section 7.5)."""
    width, height = size
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [ 3 0 R ] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [ 0 0 {width:.2f} {height:.2f} ] /Contents 4 0 R "
        "/Resources << /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>",
        f"<< /Length {len(drawing)} >>\nstream\n{drawing}\nendstream",
        f"<< /Title ({title}) >>",
    ]
    return b"".join(_file(objects))


def _file(objects: Sequence[str]) -> Iterator[bytes]:
    yield (part := b"%PDF-1.4\n")
    places, at = [], len(part)
    for number, text in enumerate(objects, start=1):
        places.append(at)
        yield (part := f"{number} 0 obj\n{text}\nendobj\n".encode("ascii"))
        at += len(part)
    count = len(objects) + 1
    rows = "".join(f"{place:010d} 00000 n \n" for place in places)
    yield (
        f"xref\n0 {count}\n0000000000 65535 f \n{rows}"
        f"trailer\n<< /Size {count} /Root 1 0 R /Info {count - 1} 0 R >>\nstartxref\n{at}\n%%EOF\n"
    ).encode("ascii")
