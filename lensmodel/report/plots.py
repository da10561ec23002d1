"""The figures of a report, drawn by matplotlib: single charts for screens, and pages for print."""

from __future__ import annotations

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Channel, Zone
from lensmodel.report.lens_report import (
    NYQUIST,
    ApertureReport,
    Comparison,
    Curve,
    LateralColourCurve,
    LensReport,
    SensorGeometry,
    Unit,
)

try:
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.ticker import MaxNLocator
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

# From soft to sharp, palest where a photo is a little soft; lightness rises and falls once, for the colour-
# blind and for print (chosen)
_SHARPNESS: Final = LinearSegmentedColormap.from_list(
    "sharpness", [(0.0, "#7f1d1d"), (0.35, "#fdf6e3"), (0.7, "#0b6e99"), (1.0, "#083d56")]
)
_CHANGES: Final = LinearSegmentedColormap.from_list("changes", ["#7f1d1d", "#fdf6e3", "#0b6e99"])
_INKS: Final = ("#0b6e99", "#b45309", "#15803d", "#7e22ce")
_CHANNELS: Final[dict[Channel, tuple[str, str]]] = {
    "r": ("red", "#c2410c"),
    "g": ("green", "#15803d"),
    "b": ("blue", "#0b6e99"),
}
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
_A_PAGE: Final = 4  # panels below each other on a page (chosen: as wide as single charts)
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
    """All charts of one aperture, those over apertures and of lateral colour last."""
    return [_chart(panel) for panel in _panels(report, report.at(aperture), unit)]


def overview(report: LensReport) -> list[Chart]:
    """The charts of the first page: the map of sharpness, and what becomes of a point."""
    return [_chart(panel) for panel in _simple(report)]


def comparison_charts(comparison: Comparison) -> list[Chart]:
    """Contrast of both at the lowest and the highest frequency they share, and the map of the difference."""
    return [_chart(panel) for panel in _compared(comparison)]


def error_history(versions: Sequence[int], errors: Mapping[Zone, Sequence[float | None]]) -> Chart:
    """Draw how the expected error of a lens fell from version to version, in each zone."""

    def draw(ax: Axes) -> None:
        for ink, (zone, shares) in zip(_INKS, errors.items(), strict=False):
            ax.plot(
                versions, [math.nan if e is None else 100.0 * e for e in shares], "o-", color=ink, label=zone
            )
        ax.set(xlabel="version of the lens", ylabel="error, %")
        ax.set_ylim(bottom=0.0)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(ax)

    return _chart(("Error after each version", _on(draw)))


def pages(report: LensReport) -> list[Figure]:
    """Draw what a photographer shows around on one page, and some for testers for each aperture."""
    drawn = [_photographer(report)]
    for number in report.apertures:
        found = report.at(number)
        panels = _panels(report, found, "c/px")
        for first in range(0, len(panels), _A_PAGE):
            figure, top = _page(report.name, "")
            _placed(figure, top, panels[first : first + _A_PAGE])
            drawn.append(figure)
    return drawn


def comparison_page(comparison: Comparison) -> Figure:
    """Draw a comparison on one page."""
    sides = (comparison.first, comparison.second)
    facts = [f"{side.name}: {side.facts}" for side in sides if side.facts]
    figure, top = _page(" and ".join(side.name for side in sides), "\n".join([comparison.verdict, *facts]))
    _placed(figure, top, _compared(comparison))
    return figure


def _panels(report: LensReport, found: ApertureReport, unit: Unit) -> list[Panel]:
    at = f", {found.at}" if found.at else ""
    panels: list[Panel] = [(f"MTF50 in {_UNITS[unit]}{at}", lambda on: _maps(on, found, report.sensor, unit))]
    panels += [
        (f"How far off MTF50 may be, in percent{at}", _on(error_map, found)),
        (
            f"Contrast from the centre to the corner{at}: sagittal (S) solid, tangential (T) dashed",
            _on(contrast, found),
        ),
        (f"Contrast by colour{at}", _on(colours, report, found.settings.aperture)),
        (f"Centring{at}", _on(side_softer, found)),
    ]
    if len(report.apertures) > 1:
        panels.append(("MTF50 by aperture", _on(over_apertures, report, unit)))
    if report.lateral is not None:
        panels.append(("Lateral colour", _on(lateral_colour, report.lateral)))
    return panels


def _compared(comparison: Comparison) -> list[Panel]:
    panels: list[Panel] = [
        ("Contrast of coarse detail", _on(both_contrasts, comparison, 0)),
        ("Contrast of fine detail", _on(both_contrasts, comparison, -1)),
    ]
    one, two = comparison.first.found, comparison.second.found
    if (one.rows, one.cols) == (two.rows, two.cols):
        panels.append(("Difference of MTF50, cycles/pixel", _on(difference, comparison)))
    return panels


def _on(draw: Callable[..., None], *given: Any) -> Callable[[Place], None]:  # noqa: ANN401 - what it draws
    """A drawing on the only axes of its place."""
    return lambda place: draw(place.add_subplot(), *given)


def _chart(panel: Panel) -> Chart:
    """One panel as a figure of its own."""
    with mpl.rc_context(_STYLE):
        figure, out = Figure(figsize=_CHART, layout="constrained"), io.BytesIO()
        _titled(figure, panel)
        figure.savefig(out, format="svg", metadata={"Date": None})
    return Chart(panel[0], out.getvalue())


def _titled(place: Place, panel: Panel) -> None:
    title, draw = panel
    place.suptitle(title, x=0.01, ha="left", fontsize=10.0)
    draw(place)


def _page(title: str, words: str, size: float = 8.5, ink: str = "#55585d") -> tuple[Figure, float]:
    """Begin a page; returns the height of the end of its words too."""
    figure = Figure(figsize=_PAGE)
    top = _written(figure, 0.97, title, 15.0, "#191a1c", "bold")
    return figure, _written(figure, top - 0.008, words, size, ink)


def _written(figure: Figure, top: float, words: str, size: float, ink: str, weight: str = "normal") -> float:
    """Write lines from a height on down, as wide as a page; return the height of their end."""
    wide = round(_LETTERS_OF_A_LINE / size)
    lines = [part for line in words.split("\n") for part in textwrap.wrap(line, wide) or [""]]
    figure.text(_LEFT, top, "\n".join(lines), fontsize=size, color=ink, weight=weight, va="top")
    return top - len(lines) * 1.25 * size / 72.0 / _PAGE[1]


def _placed(figure: Figure, top: float, panels: Sequence[Panel]) -> None:
    """Draw panels below each other, as many to a page whatever their number."""
    with mpl.rc_context(_STYLE):
        figure.set_layout_engine("constrained", rect=(0.06, 0.02, 0.88, top - 0.03))
        places: Any = figure.subfigures(_A_PAGE, 1)
        for place, panel in zip(places, panels, strict=False):
            _titled(place, panel)


def to_pdf(figures: Iterable[Figure]) -> bytes:
    """Write figures as the pages of a PDF."""
    out = io.BytesIO()
    with (
        mpl.rc_context(_STYLE),
        PdfPages(out, metadata={"CreationDate": None, "Creator": "lensmodel"}) as pdf,
    ):
        for figure in figures:
            pdf.savefig(figure)
    return out.getvalue()


def to_png(figure: Figure) -> bytes:
    """Write a figure as PNG."""
    out = io.BytesIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(out, format="png", dpi=_DOTS)
    return out.getvalue()


# --- single axes ------------------------------------------------------------------------------


def sharpness_map(ax: Axes, found: ApertureReport, values: Sequence[float], *, factor: float = 1.0) -> Any:  # noqa: ANN401 - an image of matplotlib, which colour bars take
    """Draw a map of MTF50; places of which too little is known are hatched."""
    shown = np.clip(values, 0.0, NYQUIST)
    words = [(">" if v >= NYQUIST else "") + _number(min(v, NYQUIST), factor) for v in values]
    return _map(ax, found, shown, words, _SHARPNESS, (0.0, NYQUIST), found.unknown)


def error_map(ax: Axes, found: ApertureReport) -> None:
    """Draw by how much MTF50 may be off at each place, in percent."""
    shown = np.array(found.give_or_take)
    words = [f"{100.0 * share:.0f}" for share in shown]
    _map(ax, found, np.minimum(shown, 1.0), words, "Greys", (0.0, 1.0))


def _map(
    ax: Axes,
    found: ApertureReport,
    values: NDArray[np.floating],
    words: Sequence[str],
    colours: LinearSegmentedColormap | str,
    ends: tuple[float, float],
    hatched: Sequence[bool] = (),
) -> Any:  # noqa: ANN401 - as above
    """Draw a value at each place of a report as a cell with its figure."""
    ax.grid(visible=False)
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    image = ax.imshow(
        np.asarray(values).reshape(found.rows, found.cols), cmap=colours, vmin=ends[0], vmax=ends[1],
        extent=(0.0, found.aspect, 0.0, 1.0),
    )  # fmt: skip
    wide, high = found.aspect / found.cols, 1.0 / found.rows
    for i, (word, value) in enumerate(zip(words, values, strict=True)):
        row, col = divmod(i, found.cols)
        left, low, pale = col * wide, 1.0 - (row + 1) * high, True
        if any(hatched[i : i + 1]):
            ax.add_patch(Rectangle((left, low), wide, high, **_HATCHED))
        else:
            pale = np.dot(image.to_rgba(value)[:3], _LUMA) > _PALE
        ax.text(left + wide / 2, low + high / 2, word, color="#131416" if pale else "#ffffff", **_IN_CELL)
    return image


def _number(value: float, factor: float) -> str:
    if factor != 1.0:
        return f"{value * factor:.0f}"
    return f"{value:.3f}" if 0.0 < value < 0.02 else f"{value:.2f}".removeprefix("0")


def contrast(ax: Axes, found: ApertureReport) -> None:
    """Draw contrast over the radius: sagittal solid, tangential dashed."""
    for ink, curve in zip(_INKS, found.curves, strict=False):
        _both_ways(ax, found.radii, curve, curve.name, ink)
    _radial(ax, "contrast", 1.0)


def _both_ways(ax: Axes, radii: Sequence[float], curve: Curve, name: str, ink: str) -> None:
    ax.plot(radii, curve.sagittal, color=ink, ls="-", label=f"{name} S")
    ax.plot(radii, curve.tangential, color=ink, ls="--", label=f"{name} T")


def colours(ax: Axes, report: LensReport, aperture: float | None) -> None:
    """Draw contrast of red, green and blue over the radius, mean of tangential and sagittal."""
    for found in (one for one in report.tested if one.settings.aperture == aperture):
        name, ink = _CHANNELS[found.settings.channel]
        curve = found.curves[min(1, len(found.curves) - 1)]
        both = [(t + s) / 2.0 for t, s in zip(curve.tangential, curve.sagittal, strict=True)]
        ax.plot(found.radii, both, color=ink, label=f"{name}, {curve.name}")
    _radial(ax, "contrast", 1.0)


def side_softer(ax: Axes, found: ApertureReport) -> None:
    """Draw towards which side the lens is softer, with the circle of two standard errors."""
    ax.grid(visible=False)
    ax.set_aspect("equal")
    ax.set(xlim=(-found.aspect, found.aspect), ylim=(-1.0, 1.0), xticks=[], yticks=[])
    ax.spines[["top", "right"]].set_visible(True)
    ax.plot(0.0, 0.0, "+", color="#55585d", ms=12)
    softer = found.centring.softer
    if softer is not None and softer.error < 1.0:
        scale = 1.0 / math.log(2.0)  # sides that differ by a factor of two reach the edge
        x, y = (scale * softer.amount * f(softer.direction) for f in (math.cos, math.sin))
        ax.add_patch(Circle((x, y), 2.0 * scale * softer.error, color=_INKS[0], alpha=0.2))
        ax.annotate("", (x, y), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": _INKS[1], "lw": 2.0})
        ax.set_xlabel(
            "arrow: to the softer side; circle: two standard errors; certain where the cross lies outside it"
        )
    else:
        ax.set_xlabel("too little is known to say")


def over_apertures(ax: Axes, report: LensReport, unit: Unit = "c/px") -> None:
    """Draw MTF50 of the centre and of each corner by aperture."""
    known = [
        one for one in report.tested if one.settings.channel == "g" and one.settings.aperture is not None
    ]
    stops = range(len(known))
    factor = report.sensor.factor(unit) or 1.0
    for k, spot in enumerate(known[0].spots):
        values = [factor * one.spots[k].mean for one in known]
        ax.plot(stops, values, "o-", label=spot.side.removeprefix("the "), lw=2.5 if k == 0 else 1.2)
    ax.set_xticks(list(stops), [one.at for one in known])
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel(f"MTF50, {_UNITS[unit]}")
    _legend(ax)


def lateral_colour(ax: Axes, shift: LateralColourCurve) -> None:
    """Draw by how much red and blue images lie outwards of the green one."""
    ax.plot(shift.radii, shift.red, color=_CHANNELS["r"][1], label="red")
    ax.plot(shift.radii, shift.blue, color=_CHANNELS["b"][1], label="blue")
    ax.axhline(0.0, color=_CHANNELS["g"][1], lw=0.8)
    reach = 1.2 * max(0.1, *(abs(v) for v in (*shift.red, *shift.blue)))
    _radial(ax, "pixels outwards of green", reach, low=-reach)


def both_contrasts(ax: Axes, comparison: Comparison, which: int) -> None:
    """Draw contrast of two lenses at the lowest (0) or highest (-1) frequency that both have."""
    one, two = comparison.first.found.curves, comparison.second.found.curves
    pairs = [(a, b) for a in one for b in two if a.name == b.name] or [(one[0], two[0])]
    for ink, side, curve in zip(_INKS, (comparison.first, comparison.second), pairs[which], strict=False):
        _both_ways(ax, side.found.radii, curve, side.name, ink)
    _radial(ax, f"contrast at {pairs[which][0].name}", 1.0)


def difference(ax: Axes, comparison: Comparison) -> None:
    """Draw MTF50 of the second less that of the first."""
    one, two = comparison.first.found, comparison.second.found
    values = np.array(two.mean) - np.array(one.mean)
    top = max(0.02, float(np.abs(values).max()))
    _map(ax, one, values, [f"{value:+.2f}" for value in values], _CHANGES, (-top, top))
    ax.set_xlabel(f"MTF50, cycles/pixel; blue: {comparison.second.name} is sharper")


def _legend(ax: Axes) -> None:
    """Draw the legend below, where it is seen also where the right is cut off, as wide as it may be."""
    longest = max(len(label) for label in ax.get_legend_handles_labels()[1])
    columns = max(1, min(4, _LETTERS // (longest + 6)))  # six for the line before each
    ax.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=columns)


def _radial(ax: Axes, words: str, top: float, low: float = 0.0) -> None:
    ax.set(xlim=(0.0, 1.0), ylim=(low, top), ylabel=words)
    ax.set_xlabel("0 centre, 1 corner", loc="right")
    _legend(ax)


# --- pages ------------------------------------------------------------------------------------


def _maps(place: Place, found: ApertureReport, sensor: SensorGeometry, unit: Unit) -> None:
    """Tangential and sagittal MTF50 on one scale."""
    factor = sensor.factor(unit) or 1.0
    axes = place.subplots(1, 2)
    for ax, name, values in zip(
        axes, ("tangential (T)", "sagittal (S)"), (found.tangential, found.sagittal), strict=True
    ):
        image = sharpness_map(ax, found, values, factor=factor)
        ax.set_xlabel(name)
    scale = place.colorbar(image, ax=axes, location="bottom", fraction=0.05, aspect=50)
    round_ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(0.0, NYQUIST * factor)
    ticks = [tick / factor for tick in round_ticks if tick <= NYQUIST * factor]
    scale.set_ticks(ticks, labels=[_number(tick, factor) for tick in ticks])


def _overview(ax: Axes, found: ApertureReport) -> None:
    """Mean MTF50 over the picture, with a scale in words."""
    image = sharpness_map(ax, found, found.mean)
    scale = ax.figure.colorbar(image, ax=ax, location="bottom", fraction=0.05, aspect=50)
    scale.set_ticks([0.02, 0.25, 0.43], labels=["soft", ".25", "as sharp as a sensor can show"])


def _points(place: Place, found: ApertureReport) -> None:
    """What becomes of a point in the centre and in each corner; the worst one's name is bold."""
    kernels = [np.array(spot.kernel) for spot in found.spots]
    cut = min(_dark_rim(kernel) for kernel in kernels)
    for ax, spot, kernel in zip(place.subplots(1, len(kernels)), found.spots, kernels, strict=True):
        ax.imshow(kernel[cut : len(kernel) - cut, cut : len(kernel) - cut], cmap="gray", vmin=0.0)
        weight = "bold" if spot is found.worst else "normal"
        name = spot.side.removeprefix("the ") + (" (not known)" if spot.unknown else "")
        ax.set_title(name, fontsize=8.5, weight=weight, loc="center")
        ax.set(xticks=[], yticks=[])
        ax.set_xlabel(spot.words.replace(", S", "\nS"), fontsize=7.5)
        ax.grid(visible=False)


def _dark_rim(kernel: NDArray[np.float64]) -> int:
    """Pixels around a kernel that are too dark to be seen; a few are always left in the middle."""
    rows, cols = np.nonzero(kernel > _SEEN * kernel.max())
    middle = len(kernel) // 2
    return middle - max(_LEAST_HALF, *np.abs(rows - middle), *np.abs(cols - middle))


def _simple(report: LensReport) -> list[Panel]:
    """What a photographer is shown."""
    found = report.tested[0]
    words = f"Sharpness over the picture{', ' + found.at if found.at else ''}"
    hatched = " (hatched: not known)" if any(found.unknown) else ""
    return [
        (f"{words}: MTF50, mean of T and S{hatched}", _on(_overview, found)),
        ("What becomes of a point of light in the centre and the corners", lambda on: _points(on, found)),
    ]


def _photographer(report: LensReport) -> Figure:
    """Verdict, map, what a point becomes in the centre and the corners, and what would help."""
    with mpl.rc_context(_STYLE):
        figure, top = _page(report.name, report.verdict, size=11.0, ink="#191a1c")
        below = _written(figure, 0.25, EXPLAINED, 9.0, "#191a1c")
        below = _written(figure, below - 0.012, report.advice, 11.0, "#191a1c")
        _written(figure, below - 0.012, "\n".join(report.notes), 8.5, "#55585d")
        figure.set_layout_engine("constrained", rect=(0.06, 0.26, 0.88, top - 0.28), h_pad=0.08)
        places: Any = figure.subfigures(2, 1, height_ratios=(2.6, 1.0))
        for place, panel in zip(places, _simple(report), strict=True):
            _titled(place, panel)
    return figure
