"""The target as a file to print: PNG, PDF or SVG, in 64 greys so that it stays small."""

from __future__ import annotations

import base64
import io
import zlib
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.estimation.measure.page import DOTS, TargetPage

PAPERS: Final = {"a2": (594.0, 420.0), "a3": (420.0, 297.0), "a4": (297.0, 210.0)}
"""Width and height in millimetres, lying (ISO 216)."""

SUFFIXES: Final = (".pdf", ".png", ".svg")

_GREYS: Final = 64  # levels of print: finer than a printer renders, and a small file (chosen)
_POINTS_PER_MM: Final = 72.0 / 25.4  # a point is 1/72 inch


def print_target(path: str | Path, page: TargetPage, *, paper: str = "a3") -> None:
    """Write a page to print.

    Parameters
    ----------
    path : str or Path
        Where to; its suffix says which of PDF, PNG and SVG.
    page : TargetPage
    paper : {"a2", "a3", "a4"}
        Size of the paper. A PNG says it as its resolution.

    Raises
    ------
    InvalidInputError
        For another suffix or paper.
    """
    path = Path(path)
    if paper not in PAPERS:
        raise InvalidInputError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    writers = {".pdf": _pdf, ".png": _png, ".svg": _svg}
    if path.suffix.lower() not in writers:
        raise InvalidInputError(f"{path.name}: a target is written as {', '.join(SUFFIXES)}")
    data = writers[path.suffix.lower()](_greys(page, paper), PAPERS[paper])
    with atomic(path) as file:
        file.write(data)


def _greys(page: TargetPage, paper: str) -> NDArray[np.uint8]:
    """The raster with its name in the lower border."""
    steps = np.rint(page.raster * (_GREYS - 1)) * (255.0 / (_GREYS - 1))
    picture = Image.fromarray(np.rint(steps).astype(np.uint8))
    text = f"lensmodel target, detail {page.detail}, {paper.upper()}: print at full size, grey, unsharpened"
    height = max(page.border * DOTS // 2, 10)
    place = (page.shape[1] * DOTS // 2, picture.height - page.border * DOTS // 2)
    ImageDraw.Draw(picture).text(place, text, fill=96, font_size=height, anchor="mm")
    return np.asarray(picture)


def _png(greys: NDArray[np.uint8], paper: tuple[float, float]) -> bytes:
    buffer = io.BytesIO()
    dpi = greys.shape[1] / (paper[0] / 25.4)
    Image.fromarray(greys).save(buffer, "PNG", dpi=(dpi, dpi))
    return buffer.getvalue()


def _svg(greys: NDArray[np.uint8], paper: tuple[float, float]) -> bytes:
    picture = base64.b64encode(_png(greys, paper)).decode("ascii")
    width, height = paper
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {greys.shape[1]} {greys.shape[0]}">\n'
        f'<image width="{greys.shape[1]}" height="{greys.shape[0]}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{picture}"/>\n</svg>\n'
    )
    return text.encode("ascii")


def _pdf(greys: NDArray[np.uint8], paper: tuple[float, float]) -> bytes:
    """One page with one lossless picture: PDF 1.4, ISO 32000-1, sections 7.5 and 8.9.5."""
    width, height = (side * _POINTS_PER_MM for side in paper)
    pixels = zlib.compress(greys.tobytes(), 9)
    content = f"q {width:.3f} 0 0 {height:.3f} 0 0 cm /Im0 Do Q".encode("ascii")
    bodies = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.3f} {height:.3f}] "
        "/Resources << /XObject << /Im0 4 0 R >> >> /Contents 5 0 R >>".encode("ascii"),
        f"<< /Type /XObject /Subtype /Image /Width {greys.shape[1]} /Height {greys.shape[0]} "
        "/ColorSpace /DeviceGray /BitsPerComponent 8 /Interpolate false /Filter /FlateDecode "
        f"/Length {len(pixels)} >>\nstream\n".encode("ascii")
        + pixels
        + b"\nendstream",
        f"<< /Length {len(content)} >>\nstream\n".encode("ascii") + content + b"\nendstream",
    ]
    out = io.BytesIO()
    out.write(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(bodies, start=1):
        places.append(out.tell())
        out.write(f"{number} 0 obj\n".encode("ascii") + body + b"\nendobj\n")
    table = out.tell()
    out.write(f"xref\n0 {len(bodies) + 1}\n0000000000 65535 f \n".encode("ascii"))
    out.writelines(f"{place:010d} 00000 n \n".encode("ascii") for place in places)
    out.write(
        f"trailer\n<< /Size {len(bodies) + 1} /Root 1 0 R >>\nstartxref\n{table}\n%%EOF\n".encode("ascii")
    )
    return out.getvalue()
