"""Fig. 2 (interpolation against regression), Fig. 4 (from edges to the field), and crops side by side."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lab.images import Picture, as_shown, crop_boxes
from lab.reproduce import fields
from lab.reproduce.cases import Case, Reproduction
from lab.reproduce.shots import take
from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, PsfSample, distance, rms_width
from lensmodel.core.types import FieldPosition, Kernel, Plane
from lensmodel.model import LensModel
from lensmodel.patches import r_map
from lensmodel.photo import develop
from lensmodel.workflow import sampling

# Layout (chosen): places that are shown, pixels of a kernel and of a photo's width, PSFs down and across.
_SHOWN: Final = (FieldPosition(0.5, 2.5), FieldPosition(0.8, 0.55), FieldPosition(0.95, -2.6))
_SIZE: Final = 31
_WIDTH: Final = 720
_GRID: Final = (6, 9)


def version() -> str:
    """Hash of the code: drawings of another version are drawn again."""
    total = hashlib.sha256()
    for path in (Path(__file__), Path(fields.__file__)):
        total.update(path.read_bytes())
    return total.hexdigest()[:8]


def draw(plan: Reproduction, photos: Path, folder: Path, *, workers: int = 1) -> dict[str, Any]:
    """Draw both figures into a folder, the second of the first case; return their names and figures."""
    return {"fig2": _fig2(plan.cases, folder), "fig4": _fig4(plan, photos, folder, workers)}


def names(drawn: Mapping[str, Any]) -> list[str]:
    """Pictures of the figures."""
    return [
        name
        for figure in drawn.values()
        for name in (*([figure["picture"]] if "picture" in figure else ()), *figure.get("pictures", ()))
    ]


def _fig2(cases: Sequence[Case], folder: Path) -> dict[str, Any]:
    """True PSFs of as many patches as one photo has; asked in between: error of each way, and a picture."""
    families = {c.family: [one for one in cases if one.family == c.family] for c in cases}
    # the lens whose corner is worst is the one where it matters
    worst = max(cases, key=lambda one: rms_width(one.truth().kernel_at(_SHOWN[-1], "g", _SIZE)))
    field = worst.truth()
    truth = [field.kernel_at(place, "g", _SIZE) for place in _SHOWN]
    rows, errors = [[kernel_tile(k) for k in truth]], {}
    for name, predict in fields.predictors(worst).items():
        found = [predict(place) for place in _SHOWN]
        errors[name] = [distance(a, b).rel_l2 for a, b in zip(found, truth, strict=True)]
        rows.append([kernel_tile(k) for k in found])
    Image.fromarray(_sheet(rows)).save(folder / "fig2.png", optimize=True)
    return {
        "picture": "fig2.png",
        "lens": worst.title,
        "rows": ["truth", *errors],
        "places": [[p.r, p.phi] for p in _SHOWN],
        "errors": errors,
        "table": [
            {"family": family, "lenses": len(lenses), **row}
            for family, lenses in families.items()
            for row in fields.compared(lenses)
        ],
    }


def _sheet(rows: Sequence[Sequence[NDArray[np.uint8]]], gap: int = 4) -> NDArray[np.uint8]:
    side = rows[0][0].shape[0]
    sheet = np.full((len(rows) * (side + gap) - gap, len(rows[0]) * (side + gap) - gap), 60, dtype=np.uint8)
    for i, row in enumerate(rows):
        for j, tile in enumerate(row):
            sheet[i * (side + gap) :, j * (side + gap) :][:side, :side] = tile
    return sheet


def _fig4(plan: Reproduction, photos: Path, folder: Path, workers: int) -> dict[str, Any]:
    """Confidence map with the patches, the PSF of each patch, and the regressed field."""
    case = plan.cases[0]
    shots = take(case, plan.files(), photos, photos=1)
    developed = develop(shots.learn[0])
    config = sampling.Config()
    chosen = sampling.find_patches(developed, count=config.patches, estimator=config.method)
    try:
        samples = sampling.samples_of_photo(shots.learn[0], config, workers=workers)
    except LensModelError as error:
        return {"failed": str(error)}
    green = [s for s in samples if s.settings.channel == "g"]
    frame, settings = developed.frame, case.settings
    model = LensModel.fit(samples)
    boxes = [(p.row, p.col, p.size) for p in chosen.patches]
    Image.fromarray(_small_photo(as_shown(developed.planes, case.camera.white_balance), boxes)).save(
        folder / "fig4-patches.png", optimize=True
    )
    Image.fromarray(_confidence(developed.planes[1])).save(folder / "fig4-rmap.png", optimize=True)
    _local(green, frame).save(folder / "fig4-local.png", optimize=True)
    _field(model.field(settings), frame).save(folder / "fig4-field.png", optimize=True)
    _field(case.truth(), frame).save(folder / "fig4-truth.png", optimize=True)
    return {
        "lens": case.title,
        "patches": len(boxes),
        "samples": len(green),
        "pictures": [f"fig4-{name}.png" for name in ("rmap", "patches", "local", "field", "truth")],
    }


def _confidence(plane: Plane) -> NDArray[np.uint8]:
    values = np.sqrt(np.clip(r_map(plane), 0.0, None))
    shown = np.clip(values / max(float(np.percentile(values, 99.0)), 1e-9), 0.0, 1.0)
    return _shrunk(np.rint(shown * 255).astype(np.uint8))


def _small_photo(picture: NDArray[np.uint8], boxes: Sequence[tuple[int, int, int]]) -> NDArray[np.uint8]:
    image = Image.fromarray(picture)
    pen, width = ImageDraw.Draw(image), max(picture.shape[1] // _WIDTH, 1) * 2
    for row, col, size in boxes:
        pen.rectangle((col, row, col + size, row + size), outline="#ffb300", width=width)
    return _shrunk(np.asarray(image))


def _shrunk(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = round(picture.shape[0] * _WIDTH / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize((_WIDTH, height), Image.Resampling.BOX))


def _canvas(frame: Frame) -> tuple[Image.Image, float]:
    scale = _WIDTH / frame.width
    return Image.new("L", (_WIDTH, round(frame.height * scale)), 30), scale


def _local(samples: Sequence[PsfSample], frame: Frame) -> Image.Image:
    sheet, scale = _canvas(frame)
    for sample in samples:
        row, col = frame.pixel(sample.position)
        tile = Image.fromarray(kernel_tile(sample.kernel, zoom=2))
        sheet.paste(tile, (round(col * scale - tile.width / 2), round(row * scale - tile.height / 2)))
    return sheet


def _field(field: PsfField, frame: Frame) -> Image.Image:
    sheet, scale = _canvas(frame)
    rows, cols = _GRID
    for i in range(rows):
        for j in range(cols):
            row, col = (i + 0.5) / rows * frame.height, (j + 0.5) / cols * frame.width
            tile = Image.fromarray(kernel_tile(field.kernel_at(frame.position(row, col), "g", _SIZE), zoom=2))
            sheet.paste(tile, (round(col * scale - tile.width / 2), round(row * scale - tile.height / 2)))
    return sheet


def strip(picture: Picture, side: int, gap: int = 6) -> Picture:
    """Put the five crops of `crop_boxes` side by side on white, `(side, 5 side + 4 gap, 3)`."""
    side = min(side, picture.shape[0] // 2, picture.shape[1] // 2)
    boxes = crop_boxes(picture.shape[0], picture.shape[1], side)
    sheet = np.full((side, len(boxes) * (side + gap) - gap, 3), 255, dtype=np.uint8)
    for i, (row, col) in enumerate(boxes.values()):
        left = i * (side + gap)
        sheet[:, left : left + side] = picture[row : row + side, col : col + side]
    return sheet


def kernel_tile(kernel: Kernel, zoom: int = 3, gamma: float = 0.5) -> NDArray[np.uint8]:
    """Draw a kernel, its peak white, each pixel `zoom` times; the paper's figures use gamma 0.5."""
    shown = np.rint((kernel / kernel.max()) ** gamma * 255).astype(np.uint8)
    return np.kron(shown, np.ones((zoom, zoom), dtype=np.uint8))
