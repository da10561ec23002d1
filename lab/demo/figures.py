"""Pictures of the report: 1:1 crops side by side, and the calibration history as a curve."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from lensmodel.core.files import write_atomically
from lensmodel.quality.images import Picture, crop_boxes

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
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra, and slow to import

    figure = Figure(figsize=(6.5, 3.3), layout="constrained")
    ax = figure.add_subplot()
    for name, line in series.items():
        ax.plot(range(1, len(line) + 1), line, "o-", label=f"{name} {unit}".strip())
    ax.set(xlabel=x_label, xticks=range(1, max(map(len, series.values())) + 1))
    ax.set_ylim(bottom=min(0.0, *(v for line in series.values() for v in line)))
    ax.set_title(title, loc="left", fontsize=10)
    ax.legend(frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    write_atomically(path, out.getvalue())
