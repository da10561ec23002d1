"""Pictures of the report: 1:1 crops side by side, and the calibration history as a curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lensmodel.report.photo_crops import Picture, crop_boxes

_GAP, _LABEL = 6, 18


def mosaic(rows: Mapping[str, Picture], path: Path, *, side: int = 220) -> None:
    """Write a PNG with one row of five 1:1 crops for each picture, labelled."""
    pictures = list(rows.items())
    height, width = pictures[0][1].shape[:2]
    side = min(side, height // 2, width // 2)
    boxes = crop_boxes(height, width, side)
    sheet = Image.new(
        "RGB",
        (len(boxes) * (side + _GAP) + _GAP, len(pictures) * (side + _LABEL + _GAP) + _GAP),
        "#202124",
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default()
    for i, (label, picture) in enumerate(pictures):
        top = _GAP + i * (side + _LABEL + _GAP)
        for j, (place, (row, col)) in enumerate(boxes.items()):
            left = _GAP + j * (side + _GAP)
            draw.text((left + 2, top + 3), f"{label}, {place}", fill="#e8eaed", font=font)
            sheet.paste(Image.fromarray(picture[row : row + side, col : col + side]), (left, top + _LABEL))
    sheet.save(path, optimize=True)


def curve(path: Path, *, title: str, x_label: str, series: Mapping[str, Sequence[float]], unit: str) -> None:
    """Write a small SVG line chart; x counts 1, 2, 3 ... along each series."""
    width, height, left, bottom, top, right = 460, 260, 52, 40, 34, 120
    colours = ("#1a73e8", "#d93025", "#188038", "#f29900")
    values = [v for line in series.values() for v in line]
    low, high = min(0.0, *values), max(values) * 1.08 or 1.0
    count = max(len(line) for line in series.values())

    def place(index: int, value: float) -> tuple[float, float]:
        x = left + (width - left - right) * (index / max(count - 1, 1))
        return x, height - bottom - (height - bottom - top) * (value - low) / (high - low)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="system-ui, sans-serif" font-size="12" role="img">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="{left}" y="18" font-weight="600">{escape(title)}</text>',
        f'<text x="{(left + width - right) / 2}" y="{height - 8}" '
        f'text-anchor="middle">{escape(x_label)}</text>',
    ]
    for tick in np.linspace(low, high, 5):
        _, y = place(0, float(tick))
        parts.append(f'<line x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#dadce0"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.2f}</text>')
    for index in range(count):
        x, _ = place(index, low)
        parts.append(f'<text x="{x:.1f}" y="{height - bottom + 16}" text-anchor="middle">{index + 1}</text>')
    for number, (name, line) in enumerate(series.items()):
        colour = colours[number % len(colours)]
        points = [place(i, v) for i, v in enumerate(line)]
        joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<polyline points="{joined}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>' for x, y in points]
        parts.append(
            f'<text x="{width - right + 10}" y="{top + 16 * number + 10}" '
            f'fill="{colour}">{escape(name)} {escape(unit)}</text>'
        )
    parts.append("</svg>")
    path.write_text("\n".join(parts), encoding="utf-8")
