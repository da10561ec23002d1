"""The edges of a photographed chart, to look at: where they are, their profiles and their SFR, and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Direction
from lensmodel.photo import LinearPhoto
from lensmodel.quality.edge import direction_of
from lensmodel.quality.edge_finder import FoundEdge
from lensmodel.report.lens_report import NYQUIST, SensorGeometry
from lensmodel.report.places import place_in_words

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import Normal, Stroke
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

_INKS: Final[dict[Direction, str]] = {"tangential": "#b45309", "sagittal": "#0b6e99", "oblique": "#3f9142"}
_COLUMNS, _ROWS = 4, 6  # edges on a page (chosen: curves are still read in print)
_PAGE: Final = (11.69, 8.27)  # inches: A4, lying
_WIDE: Final = 1600  # pixels of the chart on the page (chosen)
_AXES: Final = (
    "Left of each pair: light over the distance from the edge in pixels. "
    "Right: contrast (SFR) over the frequency in cycles/pixel."
)
_APART_PX: Final = 32.0  # between the middles of edges of two rows: half the smallest square (chosen)
_PROFILE_PX: Final = 8.0  # pixels of a profile on each side: where its curve is (chosen)


def in_reading_order(edges: Sequence[FoundEdge]) -> list[FoundEdge]:
    """Order edges by the rows of their chart, which may lean, from the top left."""
    quarter = math.pi / 2.0
    lean = np.median([(edge.response.normal + quarter / 2.0) % quarter - quarter / 2.0 for edge in edges])
    middles = np.array([edge.middle for edge in edges])
    down = middles @ (math.cos(lean), math.sin(lean))  # (row, col), the angle counter-clockwise
    along = middles @ (-math.sin(lean), math.cos(lean))
    order = np.argsort(down, kind="stable")
    rows = np.empty(len(edges), dtype=int)
    rows[order] = np.cumsum(np.diff(down[order], prepend=down[order[0]]) > _APART_PX)
    return [edges[k] for k in np.lexsort((along, rows))]


def edge_pages(photo: LinearPhoto, edges: Sequence[FoundEdge]) -> list[Figure]:
    """Draw the chart with every edge that was measured, numbered, then profile and SFR curve of each."""
    directions = [_direction(photo, edge) for edge in edges]
    with mpl.rc_context({"font.size": 7.0, "axes.spines.top": False, "axes.spines.right": False}):
        pages = [_chart(photo, edges, directions)]
        for number, (edge, direction) in enumerate(zip(edges, directions, strict=True)):
            place = number % (_COLUMNS * _ROWS)
            if place == 0:
                pages.append(Figure(figsize=_PAGE, layout="constrained"))
                pages[-1].supxlabel(_AXES, fontsize=7.0)
            _edge(pages[-1], place, f"{number + 1}: {direction}", edge, _INKS[direction])
    return pages


def edges_csv(photo: LinearPhoto, edges: Sequence[FoundEdge]) -> str:
    """Write a row for each edge: where it is, along what it was measured, and its figures."""
    rows = []
    for number, edge in enumerate(edges, start=1):
        (row, col), response = edge.middle, edge.response
        place = photo.frame.position(row, col)
        rows.append(
            {
                "edge": number,
                "row": f"{row:.5g}",
                "col": f"{col:.5g}",
                "r": f"{place.r:.5g}",
                "phi": f"{place.phi:.5g}",
                "place": place_in_words(place),
                "direction": _direction(photo, edge),
                "normal_deg": f"{math.degrees(response.normal):.2f}",
                "mtf50_c_px": f"{min(response.mtf50, NYQUIST):.4f}",
                "overshoot_percent": f"{response.overshoot:.2f}",
            }
        )
    out = io.StringIO()
    writer = csv.DictWriter(out, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def _direction(photo: LinearPhoto, edge: FoundEdge) -> Direction:
    return direction_of(edge.response.normal, photo.frame.position(*edge.middle))


def _chart(photo: LinearPhoto, edges: Sequence[FoundEdge], directions: Sequence[Direction]) -> Figure:
    """The chart with the box of each edge and its number."""
    page = Figure(figsize=_PAGE, layout="constrained")
    ax = page.subplots()
    step = max(photo.frame.width // _WIDE, 1)
    extent = (-0.5, photo.frame.width - 0.5, photo.frame.height - 0.5, -0.5)
    light = np.clip(photo.planes[1, ::step, ::step], 0.0, 1.0) ** (1.0 / 2.2)
    ax.imshow(light, cmap="gray", vmin=0.0, vmax=1.0, extent=extent)
    for number, (edge, direction) in enumerate(zip(edges, directions, strict=True), start=1):
        (row, col, height, width), ink = edge.box, _INKS[direction]
        ax.add_patch(Rectangle((col, row), width, height, fill=False, edgecolor=ink, lw=0.8))
        around = [Stroke(linewidth=1.5, foreground="white"), Normal()]  # legible on paper and ink
        ax.text(
            *edge.middle[::-1], f"{number}",
            color=ink, ha="center", va="center", weight="bold", path_effects=around,
        )  # fmt: skip
    ax.set_axis_off()
    counts = {name: directions.count(name) for name in _INKS}
    ax.set_title(
        f"{len(edges)} edges measured: {counts['tangential']} tangential (brown), "
        f"{counts['sagittal']} sagittal (blue), {counts['oblique']} oblique (green)",
        loc="left",
    )
    return page


def _edge(page: Figure, place: int, title: str, edge: FoundEdge, ink: str) -> None:
    """Profile and SFR of one edge beside each other."""
    response = edge.response
    left, right = (page.add_subplot(_ROWS, 2 * _COLUMNS, 2 * place + k) for k in (1, 2))
    near = np.abs(response.esf_distance) <= _PROFILE_PX
    left.plot(response.esf_distance[near], response.esf[near], color=ink)
    left.set_title(title, loc="left")
    shown = response.frequencies <= NYQUIST
    right.plot(response.frequencies[shown], response.mtf[shown], color=ink)
    right.axhline(0.5, color="#c9c9c3", lw=0.6)
    right.set(ylim=(0.0, max(1.05, float(response.mtf[shown].max()))), xlim=(0.0, NYQUIST))
    right.set_title(f"MTF50 {SensorGeometry().words(response.mtf50)}", loc="left")
