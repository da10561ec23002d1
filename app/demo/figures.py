"""Pictures of the report: 1:1 crops side by side, and the calibration history as a curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lensmodel.core.files import write_atomically
from lensmodel.report.drawing import COLOURS, Axes, Label, svg
from lensmodel.report.photo_crops import Picture, crop_boxes

_GAP, _LABEL = 6, 18  # pixels between crops and above them: a line of text fits (chosen)


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
    values = [v for line in series.values() for v in line]
    low, high = min(0.0, *values), max(values) * 1.08 or 1.0
    count = max(len(line) for line in series.values())
    axes = Axes(52, 34, 340, 220, (1.0, max(float(count), 2.0)), (low, high))
    ticks = [(float(tick), f"{tick:.2f}") for tick in np.linspace(low, high, 5)]
    parts = [
        Label(52, 18, title),
        *axes.grid([(float(k), str(k)) for k in range(1, count + 1)], ticks, x_label),
    ]
    for number, (name, line) in enumerate(series.items()):
        parts.append(axes.curve(range(1, len(line) + 1), line, COLOURS[number]))
        parts += axes.key(number, f"{name} {unit}", COLOURS[number])
    write_atomically(path, svg(title, 520, 264, parts).encode())
