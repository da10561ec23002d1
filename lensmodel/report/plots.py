"""The figures of a report, drawn by matplotlib: single charts for screens, and pages for print."""

from __future__ import annotations

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.report.lens_report import NYQUIST, ApertureReport, LensReport, Unit

try:
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage
    from matplotlib.patches import Circle, Rectangle
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

# From soft to sharp, palest where a photo is a little soft; lightness rises and falls once, for the colour-
# blind and for print (chosen)
_SHARPNESS: Final = LinearSegmentedColormap.from_list(
    "sharpness", [(0.0, "#7f1d1d"), (0.35, "#fdf6e3"), (0.7, "#0b6e99"), (1.0, "#083d56")]
)
_BLACK, _GREY = "#191a1c", "#55585d"
_INKS: Final = ("#0b6e99", "#b45309", "#15803d", "#7e22ce")
_UNITS: Final[dict[Unit, str]] = {
    "c/px": "cycles/pixel",
    "lp/ph": "line pairs per picture height",
    "lp/mm": "line pairs per mm",
}
_CHART: Final = (7.0, 3.7)  # inches of a single chart (chosen: two side by side on a wide screen)
_LETTERS: Final = 34  # of a legend beside each other (chosen: they fit in what a phone shows of a chart)
_PAGE: Final = (8.27, 11.69)  # inches: A4
_LEFT: Final = 0.07  # of the width of a page: where its lines begin (chosen)
_LETTERS_OF_A_LINE: Final = 1020.0  # over the size in points: of DejaVu Sans, narrower than the page (chosen)
_A_PAGE: Final = 3  # panels below each other on a page: those of one aperture
_IN_CELL: Final[dict[str, Any]] = {"ha": "center", "va": "center", "fontsize": 7.0}  # figures on a map
_HATCHED: Final[dict[str, Any]] = {"facecolor": "#f4f4f2", "edgecolor": "#a8a8a2", "hatch": "////", "lw": 0}
_LUMA: Final = (0.2126, 0.7152, 0.0722)  # of red, green and blue (ITU-R BT.709)
_PALE: Final = 0.45  # luma from which on dark figures are read best (chosen)
_SEEN: Final = 0.01  # of the brightest pixel of a point: darker ones look black (chosen)
_LEAST_HALF: Final = 5  # pixels shown around a point on each side, at least (chosen)
_DOTS: Final = 160  # a inch of a PNG (chosen: a page is as wide as a screen)
_STYLE: Final[dict[str, Any]] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e5e5e0",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "svg.hashsalt": "lensmodel",  # one report is one file, whenever it is drawn
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


@dataclass(frozen=True, slots=True)
class Chart:
    """One figure as SVG, with its title for those who cannot see it."""

    title: str
    svg: bytes

    @property
    def source(self) -> str:
        """An address that holds the whole figure, for an `img` element."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg).decode("ascii")


# What the signs on the first page mean (Nyquist's frequency is .5)
EXPLAINED: Final = (
    "MTF50: how fine lines may be until only half of their contrast is left, in pairs of lines per pixel "
    "(cycles/pixel); more is sharper, and a sensor shows nothing finer than .5. S: lines along the radius, "
    "which runs from the centre of the picture outwards. T: lines across it. Where S and T differ, detail is "
    "softer in one direction. In brackets: the range in which the true figure should lie."
)
Place = Figure | SubFigure
Panel = tuple[str, Callable[[Place], None]]  # Title of a drawing, and what draws it


def charts(report: LensReport, aperture: float | None, unit: Unit = "c/px") -> list[Chart]:
    """All charts of one aperture, that over apertures last."""
    drawn = []
    with mpl.rc_context(_STYLE):
        for title, draw in _panels(report, [report.at(aperture)], unit):
            figure, out = Figure(figsize=_CHART, layout="constrained"), io.BytesIO()
            _draw(figure, title, draw)
            figure.savefig(out, format="svg", metadata={"Date": None})
            drawn.append(Chart(title, out.getvalue()))
    return drawn


def pages(report: LensReport) -> list[Figure]:
    """Draw what a photographer shows around on one page, and for testers one for each aperture."""
    panels = _panels(report, report.tested, "c/px")
    with mpl.rc_context(_STYLE):
        drawn = [_photographer(report)]
        for first in range(0, len(panels), _A_PAGE):
            figure = Figure(figsize=_PAGE)
            top = _written(figure, 0.97, report.name, 15.0, weight="bold")
            _fill(figure, panels[first : first + _A_PAGE], [1.0] * _A_PAGE, 0.02, top)
            drawn.append(figure)
    return drawn


def to_pdf(figures: Iterable[Figure]) -> bytes:
    """Write figures as the pages of a PDF."""
    out = io.BytesIO()
    about = {"CreationDate": None, "Creator": "lensmodel"}
    with mpl.rc_context(_STYLE), PdfPages(out, metadata=about) as pdf:
        for figure in figures:
            pdf.savefig(figure)
    return out.getvalue()


def to_png(figure: Figure) -> bytes:
    """Write a figure as PNG."""
    out = io.BytesIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(out, format="png", dpi=_DOTS)
    return out.getvalue()


# --- what stands where --------------------------------------------------------------------------


def _panels(report: LensReport, tested: Iterable[ApertureReport], unit: Unit) -> list[Panel]:
    """What a tester is shown of each of some apertures, and at the end of all of them together."""
    factor = report.sensor.units.get(unit, 1.0)
    panels: list[Panel] = []
    for found in tested:
        at, ways = _at(found), "sagittal (S) solid, tangential (T) dashed"
        panels += [
            (f"MTF50 in {_UNITS[unit]}{at}", partial(_maps, found=found, factor=factor)),
            (f"Contrast from the centre to the corner{at}: {ways}", _on(_contrast, found)),
            (f"Centring{at}", _on(_side_softer, found)),
        ]
    if len(report.apertures) > 1:
        panels.append(("MTF50 by aperture", _on(_over_apertures, report, unit)))
    return panels


def _on(draw: Callable[..., None], *given: Any) -> Callable[[Place], None]:  # noqa: ANN401 - what it draws
    """A drawing on the only axes of its place."""
    return lambda place: draw(place.add_subplot(), *given)


def _at(found: ApertureReport) -> str:
    return f", {found.at}" if found.at else ""


def _draw(place: Place, title: str, draw: Callable[[Place], None]) -> None:
    place.suptitle(title, x=0.01, ha="left", fontsize=10.0)
    draw(place)


def _fill(figure: Figure, panels: Sequence[Panel], heights: Sequence[float], low: float, top: float) -> None:
    """Draw panels below each other on a part of a page, of relative heights."""
    figure.set_layout_engine("constrained", rect=(0.06, low, 0.88, top - low - 0.02), h_pad=0.08)
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    for place, panel in zip(parts, panels, strict=False):
        _draw(place, *panel)


def _photographer(report: LensReport) -> Figure:
    """Verdict, map, what a point becomes in the centre and the corners, and what would help."""
    figure, found = Figure(figsize=_PAGE), report.tested[0]
    top = _written(figure, 0.97, report.name, 15.0, weight="bold")
    top = _written(figure, top, report.verdict, 11.0)
    below = _written(figure, 0.25, EXPLAINED, 9.0)
    below = _written(figure, below, report.advice, 11.0)
    notes = [report.facts, *(f"{name}: {words}" for name, words in report.details.items())]
    _written(figure, below, "\n".join(notes), 8.5, _GREY)
    hatched = " (hatched: not known)" if found.unknown_share else ""
    panels: list[Panel] = [
        (f"Sharpness over the picture{_at(found)}: MTF50, mean of T and S{hatched}", _on(_overview, found)),
        ("What becomes of a point of light in the centre and the corners", lambda on: _points(on, found)),
    ]
    _fill(figure, panels, [2.6, 1.0], 0.26, top)
    return figure


def _written(
    figure: Figure, top: float, words: str, size: float, ink: str = _BLACK, weight: str = "normal"
) -> float:
    """Write lines as wide as a page from a height on down; return the height where the next begin."""
    wide = round(_LETTERS_OF_A_LINE / size)
    lines = [part for line in words.split("\n") for part in textwrap.wrap(line, wide) or [""]]
    figure.text(_LEFT, top, "\n".join(lines), fontsize=size, color=ink, weight=weight, va="top")
    return top - len(lines) * 1.25 * size / 72.0 / _PAGE[1] - 0.01


# --- maps ---------------------------------------------------------------------------------------


def _overview(ax: Axes, found: ApertureReport) -> None:
    """Mean MTF50 over the picture, with a scale in words."""
    image = _map(ax, found, [spot.mean for spot in found.map])
    scale = ax.figure.colorbar(image, ax=ax, location="bottom", fraction=0.05, aspect=50)
    scale.set_ticks([0.02, 0.25, 0.43], labels=["soft", ".25", "as sharp as a sensor can show"])


def _maps(place: Place, found: ApertureReport, factor: float) -> None:
    """Tangential and sagittal MTF50 on one scale."""
    axes = place.subplots(1, 2)
    _map(axes[0], found, [spot.tangential for spot in found.map], factor)
    image = _map(axes[1], found, [spot.sagittal for spot in found.map], factor)
    axes[0].set_xlabel("tangential (T)")
    axes[1].set_xlabel("sagittal (S)")
    place.colorbar(image, ax=axes, location="bottom", fraction=0.05, aspect=50)


def _map(ax: Axes, found: ApertureReport, values: Sequence[float], factor: float = 1.0) -> AxesImage:
    """Draw MTF50 at each place of a report as a cell with its figure; hatched where too little is known."""
    ax.grid(visible=False)
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    most, extent = factor * NYQUIST, (0.0, found.aspect, 0.0, 1.0)
    shown = np.clip(np.multiply(values, factor), 0.0, most)
    image = ax.imshow(
        shown.reshape(found.rows, found.cols), cmap=_SHARPNESS, vmin=0.0, vmax=most, extent=extent
    )
    wide, high = found.aspect / found.cols, 1.0 / found.rows
    for i, (value, spot) in enumerate(zip(shown, found.map, strict=True)):
        row, col = divmod(i, found.cols)
        left, low, pale = col * wide, 1.0 - (row + 1) * high, True
        if spot.unknown:
            ax.add_patch(Rectangle((left, low), wide, high, **_HATCHED))
        else:
            pale = np.dot(image.to_rgba(value)[:3], _LUMA) > _PALE
        word, ink = (">" if value >= most else "") + _number(value, factor), _BLACK if pale else "#ffffff"
        ax.text(left + wide / 2, low + high / 2, word, color=ink, **_IN_CELL)
    return image


def _number(value: float, factor: float) -> str:
    if factor != 1.0:
        return f"{value:.0f}"
    return f"{value:.3f}" if 0.0 < value < 0.02 else f"{value:.2f}".removeprefix("0")


# --- curves and pictures ------------------------------------------------------------------------


def _points(place: Place, found: ApertureReport) -> None:
    """What becomes of a point in the centre and in each corner; the worst one's name is bold."""
    kernels = [np.array(spot.kernel) for spot in found.spots]
    middle = len(kernels[0]) // 2
    bright = [np.abs(np.argwhere(kernel > _SEEN * kernel.max()) - middle).max() for kernel in kernels]
    half = min(max(_LEAST_HALF, *bright), middle)
    near = slice(middle - half, middle + half + 1)
    for ax, spot, kernel in zip(place.subplots(1, len(kernels)), found.spots, kernels, strict=True):
        ax.imshow(kernel[near, near], cmap="gray", vmin=0.0)
        name = spot.side + ("\n(not known)" if spot.unknown else "")
        weight = "bold" if spot is found.worst else "normal"
        ax.set_title(name, fontsize=8.5, weight=weight, loc="center", va="bottom")
        ax.set(xticks=[], yticks=[])
        ax.set_xlabel(spot.words.replace(", S", "\nS"), fontsize=7.5)
        ax.grid(visible=False)


def _contrast(ax: Axes, found: ApertureReport) -> None:
    """Contrast over the radius by frequency: sagittal solid, tangential dashed."""
    for ink, curve in zip(_INKS, found.curves, strict=False):
        ax.plot(found.radii, curve.sagittal, color=ink, ls="-", label=f"{curve.name} S")
        ax.plot(found.radii, curve.tangential, color=ink, ls="--", label=f"{curve.name} T")
    _over_the_radius(ax)


def _side_softer(ax: Axes, found: ApertureReport) -> None:
    """Towards which side the lens is softer, with the circle of two standard errors."""
    ax.grid(visible=False)
    ax.set_aspect("equal")
    ax.set(xlim=(-found.aspect, found.aspect), ylim=(-1.0, 1.0), xticks=[], yticks=[])
    ax.spines[["top", "right"]].set_visible(True)
    ax.plot(0.0, 0.0, "+", color=_GREY, ms=12)
    softer = found.centring.softer
    if softer is None or softer.error >= 1.0:
        ax.set_xlabel("too little is known to say")
        return
    # sides that differ by a factor of two reach the edge; of those that differ by more the arrow ends there
    scale = 1.0 / max(math.log(2.0), softer.amount)
    x, y = (scale * softer.amount * f(softer.direction) for f in (math.cos, math.sin))
    ax.add_patch(Circle((x, y), 2.0 * scale * softer.error, color=_INKS[0], alpha=0.2))
    ax.annotate("", (x, y), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": _INKS[1], "lw": 2.0})
    ax.set_xlabel("arrow: to the softer side; circle: two standard errors")


def _over_apertures(ax: Axes, report: LensReport, unit: Unit) -> None:
    """MTF50 of the centre and of each corner by aperture."""
    known = [one for one in report.tested if one.at]
    factor = report.sensor.units.get(unit, 1.0)
    for k, spot in enumerate(known[0].spots):
        values = [factor * one.spots[k].mean for one in known]
        ax.plot(values, "o-", label=spot.side, lw=2.5 if k == 0 else 1.2)
    ax.set_xticks(range(len(known)), [one.at for one in known])
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel(f"MTF50, {_UNITS[unit]}")
    _legend(ax)


def _legend(ax: Axes) -> None:
    """Draw the legend below, where it is seen also where the right is cut off, as wide as it may be."""
    longest = max(len(label) for label in ax.get_legend_handles_labels()[1])
    columns = max(1, min(4, _LETTERS // (longest + 6)))  # six for the line before each
    ax.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=columns)


def _over_the_radius(ax: Axes) -> None:
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), ylabel="contrast")
    ax.set_xlabel("0 centre, 1 corner", loc="right")
    _legend(ax)
