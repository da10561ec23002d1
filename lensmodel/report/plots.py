"""Drawings of a report: single charts for screens, and pages for print."""

from __future__ import annotations

import base64
import io
import textwrap
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.report.lens_report import NYQUIST, UNIT_NAMES, ApertureReport, LensReport, Unit

try:
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage
    from matplotlib.patches import Rectangle
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

# From soft to sharp, palest where a photo is a little soft; lightness rises and falls once, for the colour-
# blind and for print (chosen)
_SHARPNESS: Final = LinearSegmentedColormap.from_list(
    "sharpness", [(0.0, "#7f1d1d"), (0.35, "#fdf6e3"), (0.7, "#0b6e99"), (1.0, "#083d56")]
)
_INKS: Final = ("#0b6e99", "#b45309", "#15803d", "#7e22ce")
_CHART: Final = (7.0, 3.7)  # inches of a single chart (chosen: two side by side on a wide screen)
_PAGE: Final = (8.27, 11.69)  # inches: A4
_A_PAGE: Final = 2  # panels below each other on a page: those of one aperture
_HATCHED: Final[dict[str, Any]] = {"facecolor": "#f4f4f2", "edgecolor": "#a8a8a2", "hatch": "////", "lw": 0}
_LUMA: Final = (0.2126, 0.7152, 0.0722)  # of red, green and blue (ITU-R BT.709)
_PALE: Final = 0.45  # luma from which on dark figures are read best (chosen)
_SEEN: Final = 0.01  # of the brightest pixel of a point: darker ones look black (chosen)
_LEAST_HALF: Final = 5  # pixels shown around a point on each side, at least (chosen)
_STYLE: Final[dict[str, Any]] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e5e5e0",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "savefig.dpi": 160,  # of a PNG (chosen: a page is as wide as a screen)
    "svg.hashsalt": "lensmodel",  # one report is one file, whenever it is drawn
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


class Chart(NamedTuple):
    """One figure, with its title for those who cannot see it."""

    title: str
    source: str  # an address that holds the whole figure as SVG, for an `img` element


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
        for panel in _panels(report, [report.at(aperture)], unit):
            figure, out = Figure(figsize=_CHART, layout="constrained"), io.BytesIO()
            _draw(figure, *panel)
            figure.savefig(out, format="svg", metadata={"Date": None})
            content = base64.b64encode(out.getvalue()).decode("ascii")
            drawn.append(Chart(panel[0], f"data:image/svg+xml;base64,{content}"))
    return drawn


def document(report: LensReport, form: Literal["pdf", "png"]) -> bytes:
    """Write a report as PDF, or its first page as PNG."""
    out = io.BytesIO()
    about = {"CreationDate": None, "Creator": "lensmodel"}
    with mpl.rc_context(_STYLE):
        figures = _pages(report)
        if form == "png":
            figures[0].savefig(out, format="png")
        else:
            with PdfPages(out, metadata=about) as pdf:
                for figure in figures:
                    pdf.savefig(figure)
    return out.getvalue()


# --- what stands where --------------------------------------------------------------------------


def _pages(report: LensReport) -> list[Figure]:
    """Draw what a photographer shows around on one page, and on others what testers ask of each aperture."""
    found, panels = report.tested[0], _panels(report, report.tested, "c/px")
    hatched = " (hatched: not known)" if found.unknown_share else ""
    title = f"Sharpness over the picture{_at(found)}: MTF50, mean of T and S{hatched}"
    points = "What becomes of a point of light in the centre and the corners"
    overview: list[Panel] = [(title, partial(_overview, found)), (points, partial(_points, found))]
    first = _page(report.name, overview, [2.6, 1.0], low=0.26, top=0.86)
    notes = [report.advice, EXPLAINED, report.facts]
    notes += [f"{of}: {words}" for of, words in report.details.items()]
    _written(first, 0.945, [report.verdict], 11.0, 92)
    _written(first, 0.25, notes, 8.5, 106)  # file names in capitals fit too
    parts = [panels[k : k + _A_PAGE] for k in range(0, len(panels), _A_PAGE)]
    return [first, *(_page(report.name, part, [1.0] * _A_PAGE, low=0.02, top=0.93) for part in parts)]


def _panels(report: LensReport, tested: Iterable[ApertureReport], unit: Unit) -> list[Panel]:
    """What a tester is shown of each of some apertures, and at the end of all of them together."""
    panels: list[Panel] = []
    for found in tested:
        ways = "sagittal (S) solid, tangential (T) dashed"
        maps = partial(_maps, found, report.sensor.units.get(unit, 1.0))
        panels.append((f"MTF50 in {UNIT_NAMES[unit]}{_at(found)}", maps))
        title = f"Contrast from the centre to the corner{_at(found)}: {ways}"
        panels.append((title, partial(_contrast, found)))
    if len(report.apertures) > 1:
        panels.append(("MTF50 by aperture", partial(_over_apertures, report, unit)))
    return panels


def _at(found: ApertureReport) -> str:
    return f", {found.at}" if found.at else ""


def _draw(place: Place, title: str, draw: Callable[[Place], None]) -> None:
    place.suptitle(title, x=0.01, ha="left", fontsize=10.0)
    draw(place)


def _page(name: str, panels: Sequence[Panel], heights: Sequence[float], *, low: float, top: float) -> Figure:
    """A page with panels of relative heights below each other between two heights."""
    figure = Figure(figsize=_PAGE)
    figure.set_layout_engine("constrained", rect=(0.06, low, 0.88, top - low), h_pad=0.08)
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    for place, panel in zip(parts, panels, strict=False):
        _draw(place, *panel)
    _written(figure, 0.97, [name], 15.0, 68, "bold")
    return figure


def _written(
    figure: Figure, top: float, lines: Iterable[str], size: float, wide: int, weight: str = "normal"
) -> None:
    """Write paragraphs from a height on down, `wide` letters to the line."""
    words = "\n".join(textwrap.fill(line, wide) for line in lines)
    figure.text(0.07, top, words, fontsize=size, va="top", linespacing=1.3, weight=weight)


# --- maps ---------------------------------------------------------------------------------------


def _overview(found: ApertureReport, place: Place) -> None:
    """Mean MTF50 over the picture, with a scale in words."""
    ax = place.add_subplot()
    image = _map(ax, found, [spot.mean for spot in found.map])
    scale = place.colorbar(image, ax=ax, location="bottom", fraction=0.05, aspect=50)
    scale.set_ticks([0.02, 0.25, 0.43], labels=["soft", ".25", "as sharp as a sensor can show"])


def _maps(found: ApertureReport, factor: float, place: Place) -> None:
    """Tangential and sagittal MTF50 on one scale."""
    axes = place.subplots(1, 2)
    for k, name in enumerate(("tangential (T)", "sagittal (S)")):
        image = _map(axes[k], found, [spot.mtf50[k] for spot in found.map], factor)
        axes[k].set_xlabel(name)
    place.colorbar(image, ax=axes, location="bottom", fraction=0.05, aspect=50)


def _map(ax: Axes, found: ApertureReport, values: Sequence[float], factor: float = 1.0) -> AxesImage:
    """Draw MTF50 at each place of a report as a cell with its figure; hatched where too little is known."""
    _empty(ax)
    ax.spines[:].set_visible(False)
    most, shape = factor * NYQUIST, (found.rows, found.cols)
    shown = np.clip(np.multiply(values, factor), 0.0, most)
    aspect = found.cols / found.rows / found.aspect
    image = ax.imshow(shown.reshape(shape), cmap=_SHARPNESS, vmin=0.0, vmax=most, aspect=aspect)
    for at, value, spot in zip(np.ndindex(shape), shown, found.map, strict=True):
        row, col = at
        pale = spot.unknown or np.dot(image.to_rgba(value)[:3], _LUMA) > _PALE
        if spot.unknown:
            ax.add_patch(Rectangle((col - 0.5, row - 0.5), 1.0, 1.0, **_HATCHED))
        digits = f"{value:.0f}" if factor != 1.0 else f"{value:.2f}".removeprefix("0")
        words, ink = (">" if value >= most else "") + digits, "black" if pale else "white"
        ax.text(col, row, words, color=ink, ha="center", va="center", fontsize=7.0)
    return image


def _empty(ax: Axes) -> None:
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)


# --- curves and pictures ------------------------------------------------------------------------


def _points(found: ApertureReport, place: Place) -> None:
    """What becomes of a point in the centre and in each corner; the worst one's name is bold."""
    spots = (found.spots[0], *found.corners)
    kernels = np.array([spot.kernel for spot in spots])
    middle = kernels.shape[1] // 2
    bright = np.argwhere(kernels > _SEEN * kernels.max(axis=(1, 2), keepdims=True))[:, 1:]
    half = min(max(_LEAST_HALF, int(np.abs(bright - middle).max())), middle)
    near = slice(middle - half, middle + half + 1)
    for ax, spot, kernel in zip(place.subplots(1, len(spots)), spots, kernels, strict=True):
        ax.imshow(kernel[near, near], cmap="gray", vmin=0.0)
        name = spot.place + ("\n(not known)" if spot.unknown else "")
        ax.set_title(name, weight="bold" if spot is found.worst else "normal", va="bottom")
        ax.set_xlabel(spot.words.replace(", S", "\nS"), fontsize=7.5)
        _empty(ax)


def _contrast(found: ApertureReport, place: Place) -> None:
    """Contrast over the radius by frequency: sagittal solid, tangential dashed."""
    ax = place.add_subplot()
    for ink, curve in zip(_INKS, found.curves, strict=False):
        ax.plot(found.radii, curve.sagittal, color=ink, ls="-", label=f"{curve.name} S")
        ax.plot(found.radii, curve.tangential, color=ink, ls="--", label=f"{curve.name} T")
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), ylabel="contrast")
    ax.set_xlabel("0 centre, 1 corner", loc="right")
    _legend(ax)


def _over_apertures(report: LensReport, unit: Unit, place: Place) -> None:
    """MTF50 of the centre and of each corner by aperture."""
    ax, factor = place.add_subplot(), report.sensor.units.get(unit, 1.0)
    spots = [(one.spots[0], *one.corners) for one in report.tested]
    for k, spot in enumerate(spots[0]):
        values = [factor * of_one[k].mean for of_one in spots]
        ax.plot(values, "o-", label=spot.place, lw=2.5 if k == 0 else 1.2)
    ax.set_xticks(range(len(spots)), [one.at for one in report.tested])
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel(f"MTF50, {UNIT_NAMES[unit]}")
    _legend(ax)


def _legend(ax: Axes) -> None:
    """Draw the legend below in two columns, which is seen also where a phone cuts off the right."""
    ax.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=2)
