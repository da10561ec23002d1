"""The chart of slanted edges: dark squares on a page, all turned by five degrees, as a drawing in a PDF file.

Squares are drawn as shapes, not as pixels: a printer draws their edges as finely as it can. They are black,
since printers make greys of dots, which a photo would show along the edges.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL.PdfParser import PdfName, PdfParser

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
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
    letters = {"Type": PdfName("Font"), "Subtype": PdfName("Type1"), "BaseFont": PdfName("Helvetica")}
    with atomic(path) as file:
        pdf = PdfParser(f=file)
        pdf.info[b"Title"] = name.encode()
        page, drawing = (pdf.next_object_id(0) for _ in range(2))
        pdf.pages.append(page)
        pdf.write_header()
        pdf.write_catalog()
        box = [0, 0, round(width, 2), round(height, 2)]
        pdf.write_page(page, MediaBox=box, Contents=drawing, Resources={"Font": {"F": letters}})
        pdf.write_obj(drawing, stream="\n".join([*shapes, words]).encode("ascii"))
        pdf.write_xref_and_trailer()
