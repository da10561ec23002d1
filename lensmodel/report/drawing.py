"""Lines, boxes and texts as SVG: what the pictures of all reports are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias
from xml.sax.saxutils import escape

# sRGB (chosen: hues that are easily told apart on white)
COLOURS: Final = ("#0b6e99", "#c2410c", "#15803d", "#7e22ce", "#a16207", "#be185d", "#334155")
GREY: Final = "#6b7280"
PALE: Final = "#e5e7eb"
INK: Final = "#111827"
FONT: Final = 'font-family="system-ui, sans-serif" font-size="12"'


@dataclass(frozen=True, slots=True)
class Line:
    """One polyline in picture coordinates."""

    points: tuple[tuple[float, float], ...]
    colour: str
    width: float = 1.0
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Label:
    """One text; `anchor` is start, middle or end, `size` that of the font in pixels."""

    x: float
    y: float
    text: str
    colour: str = INK
    anchor: str = "start"
    size: float = 12.0


@dataclass(frozen=True, slots=True)
class Box:
    """One filled rectangle by its top left corner."""

    x: float
    y: float
    width: float
    height: float
    colour: str


@dataclass(frozen=True, slots=True)
class Area:
    """One filled polygon, so pale that what lies under it is seen."""

    points: tuple[tuple[float, float], ...]
    colour: str
    opacity: float = 0.18


Part: TypeAlias = Line | Label | Box | Area


@dataclass(frozen=True, slots=True)
class ReportChart:
    """A picture of parts in picture coordinates, y downwards; it is written as SVG or into a PDF."""

    title: str
    width: int
    height: int
    parts: tuple[Part, ...]

    def svg(self) -> str:
        """Return the text of an SVG file."""
        return svg(self.title, self.width, self.height, self.parts)


def svg(title: str, width: int, height: int, parts: Sequence[Part]) -> str:
    """Draw parts in their order on white, as the text of an SVG file."""
    drawn = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" {FONT}>',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        *(_element(part) for part in parts),
    ]
    return "\n".join([*drawn, "</svg>"]) + "\n"


@dataclass(frozen=True, slots=True)
class Axes:
    """A chart's area, and how values become places in it.

    Parameters
    ----------
    left, top, right, bottom : float
        Edges of the area in picture coordinates.
    x_range, y_range : tuple of float
        Values at the left and right, at the bottom and top.
    """

    left: float
    top: float
    right: float
    bottom: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Picture coordinates of a value."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        across, up = (x - x0) / (x1 - x0), (y - y0) / (y1 - y0)
        return self.left + (self.right - self.left) * across, self.bottom - (self.bottom - self.top) * up

    def grid(
        self,
        x_ticks: Sequence[tuple[float, str]],
        y_ticks: Sequence[tuple[float, str]],
        x_label: str,
    ) -> list[Part]:
        """Horizontal lines with their values, texts below, and the name of the abscissa."""
        parts: list[Part] = []
        for value, text in y_ticks:
            _, y = self.place(self.x_range[0], value)
            parts.append(Line(((self.left, y), (self.right, y)), PALE))
            parts.append(Label(self.left - 8, y + 4, text, GREY, "end"))
        for value, text in x_ticks:
            x, _ = self.place(value, self.y_range[0])
            parts.append(Label(x, self.bottom + 18, text, GREY, "middle"))
        parts.append(Label((self.left + self.right) / 2, self.bottom + 38, x_label, GREY, "middle"))
        return parts

    def curve(self, xs: Sequence[float], ys: Sequence[float], colour: str, *, dashed: bool = False) -> Line:
        """The polyline through values."""
        points = tuple(self.place(x, y) for x, y in zip(xs, ys, strict=True))
        return Line(points, colour, 2.0, dashed)

    def band(self, xs: Sequence[float], ys: Sequence[float], errors: Sequence[float], colour: str) -> Area:
        """The area of one standard error around a curve."""
        above = [self.place(x, y + e) for x, y, e in zip(xs, ys, errors, strict=True)]
        below = [self.place(x, y - e) for x, y, e in zip(xs, ys, errors, strict=True)]
        return Area(tuple(above + below[::-1]), colour)

    def key(self, number: int, text: str, colour: str, *, dashed: bool = False) -> list[Part]:
        """A line of the legend, to the right of the area."""
        x, y = self.right + 14, self.top + 12 + 20 * number
        return [Line(((x, y - 4), (x + 22, y - 4)), colour, 2.0, dashed), Label(x + 28, y, text)]


def _element(part: Part) -> str:
    return _WRITERS[type(part)](part)


def _line(line: Line) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in line.points)
    dash = ' stroke-dasharray="6 4"' if line.dashed else ""
    stroke = f'stroke="{line.colour}" stroke-width="{line.width:g}"{dash}'
    return f'<polyline points="{points}" fill="none" {stroke}/>'


def _label(label: Label) -> str:
    place = f'x="{label.x:.1f}" y="{label.y:.1f}" text-anchor="{label.anchor}"'
    size = "" if label.size == 12.0 else f' font-size="{label.size:g}"'
    return f'<text {place} fill="{label.colour}"{size}>{escape(label.text)}</text>'


def _box(box: Box) -> str:
    size = f'width="{box.width:.1f}" height="{box.height:.1f}"'
    return f'<rect x="{box.x:.1f}" y="{box.y:.1f}" {size} fill="{box.colour}"/>'


def _area(area: Area) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in area.points)
    return f'<polygon points="{points}" fill="{area.colour}" fill-opacity="{area.opacity:g}"/>'


_WRITERS: Final[dict[type[Part], Callable[..., str]]] = {
    Line: _line,
    Label: _label,
    Box: _box,
    Area: _area,
}
