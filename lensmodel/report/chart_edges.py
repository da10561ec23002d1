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
from lensmodel.report.places import place_in_words

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

_INKS: Final[dict[Direction, str]] = {"tangential": "#b45309", "sagittal": "#0b6e99", "oblique": "#3f9142"}
_HEAD: Final = (
    *("edge", "row", "col", "r", "phi", "place"),
    *("direction", "normal_deg", "mtf50_c_px", "overshoot_percent"),
)
_COLUMNS, _ROWS = 4, 6  # edges on a page (chosen: curves are still read in print)
_WIDE: Final = 1600  # pixels of the chart on the page (chosen)
_PROFILE_PX: Final = 8.0  # pixels of a profile on each side: where its curve is (chosen)


def edge_pages(photo: LinearPhoto, edges: Sequence[FoundEdge]) -> list[Figure]:
    """Draw the chart with every edge that was measured, numbered, then profile and SFR curve of each."""
    with mpl.rc_context({"font.size": 7.0, "axes.spines.top": False, "axes.spines.right": False}):
        pages = [_chart(photo, edges)]
        for start in range(0, len(edges), _COLUMNS * _ROWS):
            page = Figure(figsize=(11.69, 8.27), layout="constrained")
            for k, edge in enumerate(edges[start : start + _COLUMNS * _ROWS], start=start):
                _edge(page, k - start, f"{k + 1}", edge, _direction(photo, edge))
            pages.append(page)
    return pages


def edges_csv(photo: LinearPhoto, edges: Sequence[FoundEdge]) -> str:
    """Write a row for each edge: where it is, along what it was measured, and its figures."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_HEAD)
    for number, edge in enumerate(edges, start=1):
        place = photo.frame.position(*edge.middle)
        figures = (*edge.middle, place.r, place.phi)
        writer.writerow(
            [
                number,
                *(f"{value:.5g}" for value in figures),
                place_in_words(place),
                _direction(photo, edge),
                f"{math.degrees(edge.response.normal):.2f}",
                f"{edge.response.mtf50:.4f}",
                f"{edge.response.overshoot:.2f}",
            ]
        )
    return out.getvalue()


def _direction(photo: LinearPhoto, edge: FoundEdge) -> Direction:
    return direction_of(edge.response.normal, photo.frame.position(*edge.middle))


def _chart(photo: LinearPhoto, edges: Sequence[FoundEdge]) -> Figure:
    page = Figure(figsize=(11.69, 8.27), layout="constrained")
    ax = page.subplots()
    step = max(photo.frame.width // _WIDE, 1)
    extent = (-0.5, photo.frame.width - 0.5, photo.frame.height - 0.5, -0.5)
    light = np.clip(photo.planes[1, ::step, ::step], 0.0, 1.0) ** (1.0 / 2.2)
    ax.imshow(light, cmap="gray", vmin=0.0, vmax=1.0, extent=extent)
    for number, edge in enumerate(edges, start=1):
        row, col, height, width = edge.box
        ink = _INKS[_direction(photo, edge)]
        ax.add_patch(Rectangle((col, row), width, height, fill=False, edgecolor=ink, lw=0.8))
        ax.text(
            edge.middle[1], edge.middle[0], f"{number}", color=ink, ha="center", va="center", weight="bold"
        )
    ax.set(xticks=[], yticks=[])
    counts = {name: sum(_direction(photo, edge) == name for edge in edges) for name in _INKS}
    ax.set_title(
        f"{len(edges)} edges measured: {counts['tangential']} tangential (brown), "
        f"{counts['sagittal']} sagittal (blue), {counts['oblique']} between the two (green)",
        loc="left",
    )
    return page


def _edge(page: Figure, place: int, name: str, edge: FoundEdge, direction: Direction) -> None:
    """Profile and SFR of one edge beside each other."""
    response, ink = edge.response, _INKS[direction]
    left, right = (page.add_subplot(_ROWS, 2 * _COLUMNS, 2 * place + k) for k in (1, 2))
    near = np.abs(response.esf_distance) <= _PROFILE_PX
    left.plot(response.esf_distance[near], response.esf[near], color=ink)
    left.set_title(f"{name}: {direction}", loc="left")
    shown = response.frequencies <= 0.5
    right.plot(response.frequencies[shown], response.mtf[shown], color=ink)
    right.axhline(0.5, color="#c9c9c3", lw=0.6)
    right.set(ylim=(0.0, max(1.05, float(response.mtf[shown].max()))), xlim=(0.0, 0.5))
    figure = f"{response.mtf50:.3f}" if response.mtf50 < 0.5 else "at least .500"
    right.set_title(f"MTF50 {figure}", loc="left")
