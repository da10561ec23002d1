"""The figures of a report, drawn by matplotlib: single charts for screens, and pages for print."""

from __future__ import annotations

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically
from lensmodel.core.types import Channel
from lensmodel.report.comparison import SURE, Comparison
from lensmodel.report.lens_report import NYQUIST, ApertureReport, LensReport, SensorGeometry, Unit

try:
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle
except ModuleNotFoundError as error:
    raise InvalidInputError("drawing needs matplotlib: pip install 'lensmodel[report]'") from error

_SHARPNESS: Final = LinearSegmentedColormap.from_list(
    "sharpness", [(0.0, "#7f1d1d"), (0.35, "#fdf6e3"), (0.7, "#0b6e99"), (1.0, "#083d56")]
)
"""From soft to sharp, palest where a photo is a little soft; lightness rises and falls once, for the
colour-blind and for print (chosen)."""
_CHANGES: Final = LinearSegmentedColormap.from_list("changes", ["#7f1d1d", "#fdf6e3", "#0b6e99"])
_ERRORS: Final = LinearSegmentedColormap.from_list("errors", ["#fdf6e3", "#7f1d1d"])
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
_PAGE: Final = (8.27, 11.69)  # inches: A4
_LEAST_WIDTH_PX: Final = 0.5  # what the axis of widths shows at least: a point may have none (chosen)
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


Draw = Callable[[Axes], None]


def charts(report: LensReport, aperture: float | None, unit: Unit = "c/px") -> list[Chart]:
    """All charts of one aperture, those over apertures and of lateral colour last."""
    found = report.at(aperture)
    made = [
        _maps_chart(f"MTF50 in {_UNITS[unit]}", found, report.sensor, unit),
        _chart("Contrast over the picture", found, lambda ax: contrast(ax, found)),
        _chart("Contrast by colour", found, lambda ax: colours(ax, report, found.settings.aperture)),
        _chart("Width of a point", found, lambda ax: widths(ax, found)),
        _chart("Centring", found, lambda ax: side_softer(ax, found)),
    ]
    if found.tangential_error:
        made.insert(1, _maps_chart("Standard error of MTF50, cycles/pixel", found, report.sensor, None))
    if len(report.apertures) > 1:
        made.append(_chart("MTF50 by aperture", None, lambda ax: over_apertures(ax, report, unit)))
    if report.lateral is not None:
        made.append(_chart("Lateral colour", None, lambda ax: lateral_colour(ax, report)))
    return made


def comparison_charts(comparison: Comparison) -> list[Chart]:
    """Contrast of both at the lowest and the highest frequency they share, and the map of the difference."""
    made = []
    for which, words in ((0, "Contrast of coarse detail"), (-1, "Contrast of fine detail")):

        def draw(ax: Axes, which: int = which) -> None:
            both_contrasts(ax, comparison, which)

        made.append(_chart(words, None, draw))
    if _same_grid(comparison):
        made.append(_chart("Difference of MTF50, cycles/pixel", None, lambda ax: difference(ax, comparison)))
    return made


def pages(report: LensReport) -> list[Figure]:
    """Draw what a photographer shows around on one page, and two for testers for each aperture."""
    drawn = [_photographer(report)]
    for number in report.apertures:
        drawn += _tester(report, report.at(number))
    return drawn


def comparison_page(comparison: Comparison) -> Figure:
    """Draw a comparison on one page."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_PAGE)
        _heading(figure, f"{comparison.first.name} and {comparison.second.name}", comparison.verdict)
        top, middle, bottom = (figure.add_axes((0.1, y, 0.6, 0.2)) for y in (0.58, 0.32, 0.05))
        both_contrasts(top, comparison, 0)
        both_contrasts(middle, comparison, -1)
        if _same_grid(comparison):
            difference(bottom, comparison)
        else:
            bottom.set_axis_off()
        facts = [f"{side.name}: {side.facts}" for side in (comparison.first, comparison.second) if side.facts]
        figure.text(0.08, 0.85, "\n".join(facts), color="#55585d", fontsize=8.5, va="top")
    return figure


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


def save(figure: Figure, path: Path) -> None:
    """Write one figure as PDF, SVG or PNG, by the ending of the name, whole or not at all."""
    out = io.BytesIO()
    ending = path.suffix.lower().removeprefix(".")
    if ending not in {"pdf", "svg", "png"}:
        raise InvalidInputError(f"figures are written as .pdf, .svg or .png, got {path.name}")
    with mpl.rc_context(_STYLE):
        figure.savefig(out, format=ending, dpi=_DOTS, metadata={"Date": None} if ending == "svg" else None)
    write_atomically(path, out.getvalue())


# --- single axes ------------------------------------------------------------------------------


def sharpness_map(
    ax: Axes,
    found: ApertureReport,
    values: Sequence[float],
    *,
    factor: float = 1.0,
    top: float = NYQUIST,
    error: bool = False,
) -> Any:  # noqa: ANN401 - an image of matplotlib, which colour bars take
    """Draw a map of MTF50 or of its errors; places of which too little is known are hatched."""
    shape = found.rows, found.cols
    grid = np.clip(np.array(values, dtype=np.float64).reshape(shape), 0.0, top)
    ax.grid(visible=False)
    extent = (0.0, found.aspect, 0.0, 1.0)
    image = ax.imshow(grid, cmap=_ERRORS if error else _SHARPNESS, vmin=0.0, vmax=top, extent=extent)
    wide, high = found.aspect / found.cols, 1.0 / found.rows
    for i, value in enumerate(values):
        row, col = divmod(i, found.cols)
        left, low = col * wide, 1.0 - (row + 1) * high
        if found.unknown[i] and not error:
            ax.add_patch(
                Rectangle(
                    (left, low),
                    wide,
                    high,
                    fill=True,
                    facecolor="#f4f4f2",
                    edgecolor="#a8a8a2",
                    hatch="////",
                    lw=0,
                )
            )
        share = grid[row, col] / top
        pale = share > 0.6 if error else 0.15 < share < 0.58
        ink = "#131416" if pale != error or (found.unknown[i] and not error) else "#ffffff"
        ax.text(
            left + wide / 2,
            low + high / 2,
            _cell(value, factor, error=error),
            ha="center",
            va="center",
            color=ink,
            fontsize=7.0,
        )
    ax.set_xticks([])
    ax.set_yticks([])
    return image


def _cell(value: float, factor: float, *, error: bool) -> str:
    if not math.isfinite(value):
        return "-"
    if value >= NYQUIST and not error:
        return ">" + _number(NYQUIST, factor)
    return _number(value, factor)


def _number(value: float, factor: float) -> str:
    if factor != 1.0:
        return f"{value * factor:.0f}"
    return f"{value:.3f}" if 0.0 < value < 0.02 else f"{value:.2f}".removeprefix("0")


def contrast(ax: Axes, found: ApertureReport) -> None:
    """Draw contrast over the radius: sagittal solid, tangential dashed, bands of one standard error."""
    for ink, curve in zip(_INKS, found.curves, strict=False):
        ax.plot(found.radii, curve.sagittal, color=ink, label=f"{curve.name} S")
        ax.plot(found.radii, curve.tangential, color=ink, ls="--", label=f"{curve.name} T")
        _band(ax, found.radii, curve.sagittal, curve.sagittal_error, ink)
        _band(ax, found.radii, curve.tangential, curve.tangential_error, ink)
    _radial(ax, "contrast", 1.0)


def colours(ax: Axes, report: LensReport, aperture: float | None) -> None:
    """Draw contrast of red, green and blue over the radius, mean of tangential and sagittal."""
    for found in (one for one in report.tested if one.settings.aperture == aperture):
        name, ink = _CHANNELS[found.settings.channel]
        curve = found.curves[min(1, len(found.curves) - 1)]
        both = [(t + s) / 2.0 for t, s in zip(curve.tangential, curve.sagittal, strict=True)]
        ax.plot(found.radii, both, color=ink, label=f"{name}, {curve.name}")
    _radial(ax, "contrast", 1.0)


def widths(ax: Axes, found: ApertureReport) -> None:
    """Draw how wide a point is along the radius and around the centre: where they part is astigmatism."""
    ax.plot(found.radii, found.along_u, color=_INKS[0], ls="--", label="along the radius")
    ax.plot(found.radii, found.along_v, color=_INKS[0], label="around the centre")
    _radial(ax, "pixels, root mean square", max(_LEAST_WIDTH_PX, 1.1 * max(*found.along_u, *found.along_v)))


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
        ax.set_xlabel("arrow: the softer side; circle: two standard errors; sure if the cross lies outside")
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
        values = [factor * min(one.spots[k].mean, NYQUIST) for one in known]
        ax.plot(stops, values, "o-", label=spot.side.removeprefix("the "), lw=2.5 if k == 0 else 1.2)
    ax.set_xticks(list(stops), [one.at for one in known])
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel(f"MTF50, {_UNITS[unit]}")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def lateral_colour(ax: Axes, report: LensReport) -> None:
    """Draw by how much red and blue images lie outwards of the green one."""
    if report.lateral is None:
        ax.set_axis_off()
        return
    shift = report.lateral
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
        ax.plot(side.found.radii, curve.sagittal, color=ink, label=f"{side.name} S")
        ax.plot(side.found.radii, curve.tangential, color=ink, ls="--", label=f"{side.name} T")
        _band(ax, side.found.radii, curve.sagittal, curve.sagittal_error, ink)
        _band(ax, side.found.radii, curve.tangential, curve.tangential_error, ink)
    _radial(ax, f"contrast at {pairs[which][0].name}", 1.0)


def difference(ax: Axes, comparison: Comparison) -> None:
    """Draw MTF50 of the second less that of the first; places within two standard errors are grey."""
    one, two = comparison.first.found, comparison.second.found
    values = np.array(two.mean) - np.array(one.mean)
    spread = [np.add(f.tangential_error, f.sagittal_error) / 2.0 for f in (one, two) if f.tangential_error]
    error = np.hypot(*spread) if len(spread) == len((one, two)) else np.zeros(len(values))
    top = max(0.02, float(np.abs(values).max()))
    ax.grid(visible=False)
    shown = np.where(np.abs(values) > SURE * error, values, 0.0).reshape(one.rows, one.cols)
    ax.imshow(shown, cmap=_CHANGES, vmin=-top, vmax=top, extent=(0.0, one.aspect, 0.0, 1.0))
    for i, value in enumerate(values):
        row, col = divmod(i, one.cols)
        text = f"{value:+.2f}" if abs(value) > SURE * error[i] else "·"
        ax.text(
            (col + 0.5) * one.aspect / one.cols,
            1.0 - (row + 0.5) / one.rows,
            text,
            ha="center",
            va="center",
            fontsize=7.0,
        )
    ax.set(xticks=[], yticks=[])
    ax.set_xlabel(f"MTF50, cycles/pixel; blue: {comparison.second.name} is sharper; a dot: within the error")


def _band(
    ax: Axes, radii: Sequence[float], values: Sequence[float], errors: Sequence[float], ink: str
) -> None:
    if errors:
        low, high = np.subtract(values, errors), np.add(values, errors)
        ax.fill_between(radii, np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0), color=ink, alpha=0.12, lw=0)


def _radial(ax: Axes, words: str, top: float, low: float = 0.0) -> None:
    ax.set(xlim=(0.0, 1.0), ylim=(low, top), xlabel="0 centre, 1 corner", ylabel=words)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _same_grid(comparison: Comparison) -> bool:
    one, two = comparison.first.found, comparison.second.found
    return (one.rows, one.cols) == (two.rows, two.cols)


# --- charts and pages -------------------------------------------------------------------------


def _svg(figure: Figure, title: str) -> Chart:
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return Chart(title, out.getvalue())


def _chart(title: str, found: ApertureReport | None, draw: Draw) -> Chart:
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_CHART, layout="constrained")
        ax = figure.add_subplot()
        draw(ax)
        words = f"{title}, {found.at}" if found is not None and found.at else title
        ax.set_title(words)
        return _svg(figure, words)


def _maps_chart(title: str, found: ApertureReport, sensor: SensorGeometry, unit: Unit | None) -> Chart:
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_CHART, layout="constrained")
        words = f"{title}, {found.at}" if found.at else title
        figure.suptitle(words, x=0.01, ha="left", fontsize=10.0)
        _two_maps(figure, list(figure.subplots(1, 2)), found, sensor, unit, None)
        return _svg(figure, words)


def _two_maps(
    figure: Figure,
    axes: list[Axes],
    found: ApertureReport,
    sensor: SensorGeometry,
    unit: Unit | None,
    below: Axes | None,
) -> None:
    """Tangential and sagittal on one scale: MTF50 in a unit, or its errors where the unit is None."""
    error = unit is None
    kinds = (found.tangential_error, found.sagittal_error) if error else (found.tangential, found.sagittal)
    if error:  # an error of a figure beyond what the sensor shows is none
        both = zip(kinds, (found.tangential, found.sagittal), strict=True)
        kinds = tuple(
            tuple(math.nan if v >= NYQUIST else e for e, v in zip(*one, strict=True)) for one in both
        )  # type: ignore[assignment]
    top = max(0.01, float(np.nanmax([*kinds[0], *kinds[1], 0.0]))) if error else NYQUIST
    factor = 1.0 if unit is None else sensor.factor(unit) or 1.0
    for ax, name, values in zip(axes, ("tangential", "sagittal"), kinds, strict=True):
        image = sharpness_map(ax, found, values, factor=factor, top=top, error=error)
        ax.set_xlabel(name)
    where: dict[str, Any] = {"ax": axes, "location": "bottom", "fraction": 0.05, "aspect": 50}
    if below is not None:
        where = {"cax": below, "orientation": "horizontal"}
    scale = figure.colorbar(image, **where)
    ticks = np.linspace(0.0, top, 6)
    scale.set_ticks(ticks.tolist(), labels=[_number(t, factor) for t in ticks])


def _heading(figure: Figure, title: str, words: str) -> None:
    figure.text(0.08, 0.955, title, fontsize=17, weight="bold", va="top")
    figure.text(0.08, 0.92, textwrap.fill(words, 78), fontsize=11, va="top", linespacing=1.4)


def _photographer(report: LensReport) -> Figure:
    """Verdict, map, corners as pictures, and what would help."""
    found = report.tested[0]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_PAGE)
        _heading(figure, report.name, report.verdict)
        big = figure.add_axes((0.08, 0.44, 0.84, 0.38))
        image = sharpness_map(big, found, found.mean)
        words = f"Sharpness over the picture{', ' + found.at if found.at else ''}"
        big.set_title(f"{words} (MTF50, cycles/pixel; hatched: not known)")
        worst = found.worst
        reach = 0.5 * math.hypot(found.aspect, 1.0) * worst.position.r
        x, y = (reach * f(worst.position.phi) for f in (math.cos, math.sin))
        big.add_patch(Circle((found.aspect / 2 + x, 0.5 + y), 0.07, fill=False, edgecolor="#131416", lw=2.0))
        scale = figure.colorbar(
            image, cax=figure.add_axes((0.08, 0.415, 0.84, 0.012)), orientation="horizontal"
        )
        scale.set_ticks([0.0, 0.25, 0.5], labels=["soft", ".25", "no sensor shows more"])
        scale.ax.get_xticklabels()[0].set_horizontalalignment("left")
        scale.ax.get_xticklabels()[-1].set_horizontalalignment("right")
        star = _star(61)
        for k, spot in enumerate(found.spots):
            ax = figure.add_axes((0.08 + 0.172 * k, 0.2, 0.155, 0.13))
            kernel = np.array(spot.kernel)
            ax.imshow(_through(star, kernel), cmap="gray", vmin=0.0, vmax=1.0)
            bold = "bold" if spot is worst else "normal"
            ax.set_title(spot.side.removeprefix("the "), fontsize=8.5, weight=bold, loc="center")
            ax.set(xticks=[], yticks=[])
            ax.grid(visible=False)
            ax.set_xlabel(
                f"T {_cell(spot.tangential, 1.0, error=False)}  S {_cell(spot.sagittal, 1.0, error=False)}"
            )
        figure.text(0.08, 0.365, "A star of fine lines as the lens draws it", fontsize=10)
        lines = [report.facts, *(f"{k}: {v}" for k, v in report.details.items())]
        figure.text(0.08, 0.165, textwrap.fill(report.advice.text, 95), fontsize=10, va="top")
        wrapped = "\n".join(textwrap.fill(line, 120) for line in lines)
        figure.text(0.08, 0.115, wrapped, fontsize=8, color="#55585d", va="top")
    return figure


def _tester(report: LensReport, found: ApertureReport) -> list[Figure]:
    """Maps with their errors and curves; colours, widths, apertures, centring and lateral colour."""
    title = f"{report.name}{', ' + found.at if found.at else ''}"
    with mpl.rc_context(_STYLE):
        first = Figure(figsize=_PAGE)
        first.text(0.08, 0.97, title, fontsize=13, weight="bold", va="top")
        kinds: list[tuple[float, Unit | None, str]] = [(0.70, "c/px", "MTF50, cycles/pixel")]
        kinds += [(0.40, None, "Its standard error")] if found.tangential_error else []
        for low, unit, words in kinds:
            first.text(0.08, low + 0.225, words, fontsize=10)
            axes = [first.add_axes((left, low, 0.41, 0.21)) for left in (0.08, 0.51)]
            _two_maps(
                first, axes, found, report.sensor, unit, first.add_axes((0.08, low - 0.035, 0.84, 0.01))
            )
        ax = first.add_axes((0.1, 0.09, 0.64, 0.22))
        contrast(ax, found)
        ax.set_title("Contrast over the picture: sagittal solid, tangential dashed")
        first.text(0.08, 0.02, textwrap.fill(report.error_words, 120), fontsize=7.5, color="#55585d")
        second = Figure(figsize=_PAGE)
        second.text(0.08, 0.965, title, fontsize=13, weight="bold", va="top")
        draws: list[tuple[str, Draw]] = [
            ("Contrast by colour", lambda ax: colours(ax, report, found.settings.aperture)),
            ("Width of a point: where the lines part is astigmatism", lambda ax: widths(ax, found)),
            ("Centring", lambda ax: side_softer(ax, found)),
        ]
        if report.lateral is not None:
            draws.append(("Lateral colour", lambda ax: lateral_colour(ax, report)))
        if len(report.apertures) > 1:
            draws.append(("MTF50 by aperture", lambda ax: over_apertures(ax, report)))
        high = 0.9 / len(draws)
        for k, (words, draw) in enumerate(draws):
            ax = second.add_axes((0.1, 0.94 - (k + 1) * high + 0.05, 0.62, high - 0.085))
            draw(ax)
            ax.set_title(words)
    return [first, second]


def _star(side: int) -> NDArray[np.float64]:
    """A Siemens star of 16 pairs, drawn at four times the resolution."""
    t = (np.arange(4 * side) + 0.5) / 4 - side / 2
    angle = np.arctan2(t[:, None], t[None, :])
    fine = (np.cos(16 * angle) > 0).astype(np.float64)
    return fine.reshape(side, 4, side, 4).mean(axis=(1, 3))


def _through(star: NDArray[np.float64], kernel: NDArray[np.float64]) -> NDArray[np.float64]:
    reach = kernel.shape[0] // 2
    padded = np.pad(star, reach, mode="reflect")
    return np.asarray(fftconvolve(padded, kernel, mode="valid"))
