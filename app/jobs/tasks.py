"""Tasks that run in child processes: functions of the library, called with JSON and files.

A task takes JSON and its own empty folder, and returns JSON. Arrays go in and out as files in the
folder, PSF samples by `app.jobs.sample_files`. No task accesses the database or other photos.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import logging
import math
import mmap
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageOps

from app import distances
from app.blobs.tiles import write_tiles
from app.jobs.answers import CLEANED, LAYER_FILES, REPORT, SHOWN, SIDES, SUFFIX, THUMBNAIL
from app.jobs.sample_files import read_samples, write_samples
from app.sandbox.child import ProgressHook, Task
from lensmodel import api, correction, photo
from lensmodel import measured as lens_measure
from lensmodel.blind import sampling
from lensmodel.core.errors import ImageTooLargeError, LensModelError
from lensmodel.core.files import from_json, to_json
from lensmodel.core.names import camera_name
from lensmodel.core.types import FieldPosition, LensSettings, Planes
from lensmodel.model import LensModel
from lensmodel.model.profile import read_profile
from lensmodel.neural.network import FieldNetwork
from lensmodel.patches import Patch
from lensmodel.photo.lateral import LateralColour
from lensmodel.photo.metadata import find_location
from lensmodel.report.lens_report import lens_report

log = logging.getLogger(__name__)

# Longer side of a thumbnail in pixels at most (chosen): sharp at 240 CSS pixels on a high-density screen
THUMBNAIL_SIDE: Final = 480
CIFF: Final = b"HEAPCCDR"  # signature of Canon's CRW at byte 6: not TIFF, and from cameras without GPS
# What the library imports where it is used: here the fork server does it once, not each of its children
LATE: Final = ("scipy.interpolate", "scipy.optimize", "lensmodel.core.numerics")

for _module in LATE:
    importlib.import_module(_module)


def _ready_for_loops() -> None:
    """Let Numba set up what every compiled loop needs: each child would take a third of a second for it."""
    with contextlib.suppress(ImportError, AttributeError):  # names that it may change
        target = importlib.import_module("numba.core.registry").cpu_target
        target.typing_context.refresh()
        target.target_context.refresh()


_ready_for_loops()


def locate(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Say whether `path` tells where it was taken; a copy without, of the same length, goes to the folder."""
    del progress
    path, cleaned = Path(arguments["path"]), folder / CLEANED
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        if mapped[6:14] == CIFF:
            return {"location": "none"}
        overwrites, complete = find_location(mapped)
    if overwrites:
        shutil.copyfile(path, cleaned)
        with cleaned.open("r+b") as copy:
            for start, data in overwrites:
                copy.seek(start)
                copy.write(data)
    if not complete:
        return {"location": "unknown"}
    return {"location": "removed" if overwrites else "none"}


def inspect(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Return the header of `path`: size, kind, camera, lens, settings; a small picture goes to the folder."""
    del progress
    path = Path(arguments["path"])
    info = photo.inspect(path, photo.Limits(max_megapixels=arguments["max_megapixels"]))
    try:
        picture = thumbnail(path, info.kind, info.metadata.orientation or 1)
    except Exception as error:  # noqa: BLE001 - decoders of hostile files raise all kinds; the photo goes on without
        log.warning("no small picture: %s: %s", type(error).__name__, error)
    else:
        (folder / THUMBNAIL).write_bytes(picture)
    header: dict[str, Any] = to_json(info)
    header["metadata"]["focus_m"] = distances.written(info.metadata.focus_m)
    return header


def develop(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    """Develop `path` to linear planes in the folder."""
    del progress
    limits = photo.Limits(max_megapixels=arguments["max_megapixels"])
    developed = photo.develop(Path(arguments["path"]), limits=limits)
    sampling.save_developed(developed, folder)
    _show(folder / SHOWN, developed.planes, developed)


def select(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Choose the patches of the photo developed in `developed`, and measure its lateral colour."""
    del folder
    developed = sampling.load_developed(Path(arguments["developed"]))
    selection = sampling.find_patches(
        developed,
        count=arguments["count"],
        selector=arguments["selector"],
        estimator=arguments["estimator"],
        on_step=progress,
    )
    patches = [{**_window(patch), "score": patch.score, "cell": patch.cell} for patch in selection.patches]
    rejected = [{**_window(patch), "reason": patch.reason} for patch in selection.rejected]
    return {"patches": patches, "rejected": rejected, "lateral": to_json(_lateral(developed))}


def estimate(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> list[int]:
    """Estimate the PSF of one field cell in each channel; return of which patch each sample is."""
    # The samples go to the folder
    developed = sampling.load_developed(Path(arguments["developed"]))
    group = [from_json(Patch, stored) for stored in arguments["patches"]]
    numbers = {patch.position: idx for patch, idx in zip(group, arguments["numbers"], strict=True)}
    samples = sampling.estimate_cell(
        developed,
        group,
        settings=_settings(arguments["settings"]),
        photo_id=arguments["photo"],
        estimator=arguments["estimator"],
        size=arguments["size"],
        on_step=progress,
    )
    write_samples(folder, samples)
    return [numbers[sample.position] for sample in samples]


def correct(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Correct the photo in `developed` with the samples in the folder; write the result there."""
    # A compressed photo that would gain nothing to be seen is left as it is, which some of its cells tell
    # soon. The photo's own samples join them, unless they are there already: `photo` is what they are called.
    developed = sampling.load_developed(Path(arguments["developed"]))
    stored = arguments["lateral"]
    lateral = _lateral(developed) if stored is None else from_json(LateralColour, stored)
    params = arguments["params"]
    output, roi = params["output"], params.get("roi")
    model = LensModel.fit(read_samples(folder))
    settings = _settings(arguments["settings"])
    bounds = correction.Bounds(**arguments["bounds"])
    extremes = (replace(bounds, texture=0.0), replace(bounds, texture=1.0, denoise=1.0))
    corrected = api.correct_photo(
        developed,
        model,
        settings,
        method=params["method"],
        photo=arguments["photo"],
        strength=params["strength"],
        bounds=bounds,
        layers=extremes if params.get("layers") else (),
        lateral=lateral,
        roi=None if roi is None else (roi["y"], roi["x"], roi["height"], roi["width"]),
        least_gain_db=api.SEEN_DB if developed.lossy and roi is None else None,
        workers=arguments["workers"],
        on_step=progress,
    )
    name = f"result{SUFFIX[output['format']]}"
    photo.write_image(
        folder / name,
        corrected.planes,
        developed.encoding,
        format=output["format"],
        color_space=output["color_space"],
        quality=output["quality"],
        description=arguments["description"],
        lens=arguments.get("lens", ""),
    )
    height, width = corrected.planes.shape[1:]
    top, left = (0, 0) if roi is None else (roi["y"], roi["x"])
    part = np.ascontiguousarray(developed.planes[:, top : top + height, left : left + width])
    if roi is None:
        _show(folder / SIDES["before"], part, developed)
        _show(folder / SIDES["after"], corrected.planes, developed)
    else:
        for layer, planes in zip(
            LAYER_FILES.values(), (part, corrected.planes, *corrected.layers), strict=False
        ):
            photo.write_image(folder / layer, planes, developed.encoding, format="png8", color_space="srgb")
    report = {
        "zones": corrected.zones,
        "nothing_to_correct": corrected.nothing_to_correct,
        "audit": corrected.audit,
    }
    return {"file": name, "report": _numbers(to_json(report))}


def measure(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Return the errors that the model of the samples in the folder expects; write the report of the lens.

    `about` has the name of the lens and the shape of its photos.
    """
    model, about = LensModel.fit(read_samples(folder)), arguments["about"]
    try:
        report = lens_report(
            model, about["name"], aspect=about["aspect"], height_px=about["height_px"], on_step=progress
        )
    except LensModelError as refusal:
        log.info("a lens without a report: %s", refusal)
    else:
        (folder / REPORT).write_text(json.dumps(_numbers(to_json(report))), encoding="utf-8")
    error = to_json(model.expected_errors())
    return {"error": _numbers(error), "coverage": _numbers(to_json(model.coverage()))}


def measure_lens(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> list[dict[str, Any]]:
    """Measure the PSF on photos made for it, in `developed`; samples go to the folder."""
    photos = [sampling.load_developed(Path(name)) for name in arguments["developed"]]
    samples = lens_measure.methods.create(arguments["kind"]).measure(
        photos,
        size=(side := arguments["size"]),
        settings=_settings(arguments["settings"]),
        photo_id=arguments["photo"],
        on_step=progress,
    )
    write_samples(folder, samples)
    numbers: dict[FieldPosition, int] = {}
    places = []
    for sample in samples:
        row, col = (round(middle - (side - 1) / 2) for middle in photos[0].frame.pixel(sample.position))
        number = numbers.setdefault(sample.position, len(numbers))
        places.append({"idx": number, "row": row, "col": col, "side": side})
    return places


def profile(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Read the lens profile at `path`; its samples go to the folder."""
    del progress
    path, most = Path(arguments["path"]), arguments["max_unpacked"]
    # what cannot be opened is named by `read_profile`
    with (
        contextlib.suppress(zipfile.BadZipFile, ValueError, NotImplementedError),
        zipfile.ZipFile(path) as archive,
    ):
        unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > most:
            raise ImageTooLargeError(
                f"the profile unpacks to {unpacked >> 20} MiB, {most >> 20} MiB may be: send less"
            )
    with path.open("rb") as file:
        read = read_profile(file, "This file")
    samples = read.model.samples
    write_samples(folder, samples)
    cameras = sorted({camera_name(camera.maker, camera.model) for camera in read.cameras} - {""})
    # of the cameras the service asks only whether there is one
    named = {"photos": read.photos, "lens": read.names, "cameras": cameras[:2]}
    return {"mode": read.model.mode, "samples": len(samples), **named}


_NAMED: Final = (locate, inspect, develop, select, estimate, correct, measure, measure_lens, profile)
TASKS: Final[Mapping[str, Task]] = {task.__name__.replace("_", "-"): task for task in _NAMED}

FieldNetwork.load()  # in the fork server: a confined child may no longer read the weights, which all share


def _window(patch: Patch) -> dict[str, Any]:
    square = {"row": patch.row, "col": patch.col, "size": patch.size}
    return {**square, "r": patch.position.r, "phi": patch.position.phi}


def thumbnail(path: Path, kind: str, orientation: int) -> bytes:
    """Render a photo file as a small upright JPEG."""
    if kind in {"jpeg", "png"}:
        with Image.open(path) as image:
            image.draft("RGB", (2 * THUMBNAIL_SIDE, 2 * THUMBNAIL_SIDE))
            shown = ImageOps.exif_transpose(image).convert("RGB")
    elif kind == "tiff":
        pixels = tifffile.imread(path)
        step = max(1, max(pixels.shape[:2]) // THUMBNAIL_SIDE)
        shown = Image.fromarray(photo.upright(_eight_bits(pixels[::step, ::step]), orientation)).convert(
            "RGB"
        )
    else:
        with rawpy.imread(str(path)) as raw:
            shown = Image.fromarray(raw.postprocess(half_size=True, use_camera_wb=True, output_bps=8))
    shown.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    out = io.BytesIO()
    shown.save(out, "JPEG", quality=82)
    return out.getvalue()


def _eight_bits(pixels: np.ndarray) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)
    light = np.clip(np.nan_to_num(pixels.astype(np.float64)), 0.0, 1.0)
    return np.rint(255.0 * light ** (1 / 2.2)).astype(np.uint8)


def _show(path: Path, planes: Planes, developed: photo.LinearPhoto) -> None:
    """Write planes as upright sRGB tiles."""
    upright = photo.upright(photo.shown(planes, developed.encoding), developed.info.metadata.orientation)
    write_tiles(path, upright)


def _lateral(developed: photo.LinearPhoto) -> LateralColour | None:
    try:
        return api.lateral_of(developed)
    except LensModelError as error:
        log.info("no lateral colour: %s", error)
        return None


def _settings(stored: Mapping[str, Any]) -> LensSettings:
    return LensSettings(**{**stored, "focus_m": distances.read(stored["focus_m"])})


def _numbers(value: Any) -> Any:  # noqa: ANN401 - JSON of any shape
    """Replace numbers that JSON cannot represent by null."""
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
