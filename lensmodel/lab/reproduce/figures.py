"""Fig. 2 (interpolation against regression) and Fig. 4 (from edges to the field)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, PsfSample, distance, rms_width
from lensmodel.core.types import FieldPosition, Plane
from lensmodel.estimation.patches import r_map
from lensmodel.lab.model.model_benchmark import patch_places, predictor, run_model_benchmark
from lensmodel.lab.reproduce.cases import Case, Reproduction
from lensmodel.lab.reproduce.shots import take
from lensmodel.model import LensModel
from lensmodel.photo import develop
from lensmodel.report.photo_crops import as_shown, kernel_tile
from lensmodel.simulate import draw_lens
from lensmodel.workflow import pipeline

COMPARED: Final = ("eff-linear", "paper", "blended")
_SHOWN: Final = (FieldPosition(0.5, 2.5), FieldPosition(0.8, 0.55), FieldPosition(0.95, -2.6))
_SIZE: Final = 31
_WIDTH: Final = 720
_GRID: Final = (6, 9)


def version() -> str:
    """Hash of this file: drawings of another version are drawn again."""
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]


def draw(plan: Reproduction, case: Case, folder: Path, *, workers: int | None = None) -> dict[str, Any]:
    """Draw both figures into a folder and return their names and figures."""
    seeds = sorted({c.seed for c in plan.cases})
    return {"fig2": _fig2(seeds, folder), "fig4": _fig4(plan, case, folder, workers)}


def _fig2(seeds: Sequence[int], folder: Path) -> dict[str, Any]:
    """True PSFs at the patches of one photo; asked in between: error of each way, and a picture."""
    table = run_model_benchmark(seeds=seeds, photos=(1,), methods=COMPARED)
    # the lens whose corner is worst is the one where it matters
    worst = max(seeds, key=lambda seed: rms_width(draw_lens(seed).kernel(_SHOWN[-1], None, _SIZE)))
    lens = draw_lens(worst)
    rng = np.random.default_rng(worst)
    samples = [PsfSample(lens.kernel(p, None, _SIZE), p, photo="photo0") for p in patch_places(rng)]
    rows, errors = [], []
    truth = [lens.kernel(place, None, _SIZE) for place in _SHOWN]
    rows.append([kernel_tile(k) for k in truth])
    for name in COMPARED:
        predict = predictor(name, samples)
        found = [predict(place) for place in _SHOWN]
        errors.append([distance(a, b).rel_l2 for a, b in zip(found, truth, strict=True)])
        rows.append([kernel_tile(k) for k in found])
    sheet = _sheet(rows)
    Image.fromarray(sheet).save(folder / "fig2.png", optimize=True)
    return {
        "picture": "fig2.png",
        "lens": lens.model,
        "rows": ["truth", *COMPARED],
        "places": [[p.r, p.phi] for p in _SHOWN],
        "errors": dict(zip(COMPARED, errors, strict=True)),
        "table": table["rows"],
        "seeds": list(seeds),
    }


def _sheet(rows: Sequence[Sequence[NDArray[np.uint8]]], gap: int = 4) -> NDArray[np.uint8]:
    side = rows[0][0].shape[0]
    sheet = np.full((len(rows) * (side + gap) - gap, len(rows[0]) * (side + gap) - gap), 60, dtype=np.uint8)
    for i, row in enumerate(rows):
        for j, tile in enumerate(row):
            sheet[i * (side + gap) :, j * (side + gap) :][:side, :side] = tile
    return sheet


def _fig4(plan: Reproduction, case: Case, folder: Path, workers: int | None) -> dict[str, Any]:
    """Confidence map with the patches, the PSF of each patch, and the regressed field."""
    with TemporaryDirectory(prefix="lensmodel-figure-") as work:
        shots = take(case, plan.files(), Path(work), first=1)
        developed = develop(shots.learn[0])
        chosen = pipeline.find_patches(developed)
        try:
            samples = pipeline.samples_of_photo(shots.learn[0], estimator=plan.estimator, workers=workers)
        except LensModelError as error:
            return {"failed": str(error)}
    green = [s for s in samples if s.settings.channel == "g"]
    frame, settings = developed.frame, case.settings
    model = LensModel.fit(samples).warmed()
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
