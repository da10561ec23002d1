"""Sharp scenes in linear light: photographs scaled down until their own blur is gone, and drawn ones.

A photograph enters by its bytes, from files or from the objects of a git repository, so that whole
collections serve without being unpacked. Photographs of the laboratory's test half (`photo_half`) are never
trained on.
"""

from __future__ import annotations

import io
import json
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lab.scenes import dead_leaves, text
from lensmodel.core.files import write_atomically
from lensmodel.photo.colour import srgb_to_linear

Scene = NDArray[np.float16]  # (height, width, 3), linear light, white 1

_LONGEST: Final = 1800  # pixels of the longer side after scaling down: most cameras' own blur is then gone
_LEAST_FACTOR: Final = 2.2  # by which a photograph is scaled down at least (chosen: blur below .3 pixels)
_SHARPEST: Final = 0.10  # least share of gradient energy in the finest band; below it a photograph is soft
_SCALES: Final = (1.0, 1.5, 2.3)  # further factors that each photograph is scaled down by

_SPECTRUM_SIDE: Final = 128  # pixels of windows that a scene's spectrum is of: those of a patch
_NATURAL_SLOPE: Final = 2.0  # of power against frequency: D. J. Field, JOSA A 4, 1987
_SLOPE_HELD: Final = 1.0  # how many rings' worth of weight that has in a fit (chosen)

# originals of the photographs of the test half, as their collections name them
TEST_HALF: Final = (
    "beacon-street-sunset",
    "canyon-wren",
    "perched-osprey",
    "roman-colosseum",
    "singaporean-cityscape",
    "jad-limcaco-183877",
    "spacex-81773",
    "jared-evans-119758",
    "Apple iPhone 4S",
    "Kodak PIXPRO AZ521",
    "Oppo R7 Plus",
    "Samsung SM-N900A (Galaxy Note 3)",
)


@dataclass(frozen=True, slots=True)
class Source:
    """One photograph: where it comes from, its bytes, and whether it may be scaled down less."""

    name: str
    data: bytes
    ready: bool = False  # scaled down already


def files_of(folder: Path) -> Iterator[Source]:
    """Photographs of a folder that are sharp already."""
    for path in sorted(folder.glob("*.png")):
        yield Source(path.stem, path.read_bytes(), ready=True)


def objects_of(repository: Path, under: str) -> Iterator[Source]:
    """Photographs in the newest commit of a git repository; those whose objects are absent are left out."""
    listed = subprocess.run(
        ["git", "-C", str(repository), "ls-tree", "-r", "-l", "HEAD", "--", under],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for line in listed.splitlines():
        facts, _, name = line.partition("\t")
        size = facts.split()[3]
        if size.isdigit() and int(size) > 300_000 and name.lower().endswith((".jpg", ".jpeg")):
            read = ["git", "-C", str(repository), "cat-file", "blob", facts.split()[2]]
            yield Source(Path(name).stem, subprocess.run(read, capture_output=True, check=True).stdout)


def linear(data: bytes) -> NDArray[np.float32]:
    """Decode a picture to linear light (sRGB), float32 of shape (height, width, 3)."""
    with Image.open(io.BytesIO(data)) as picture:
        return srgb_to_linear(np.asarray(picture.convert("RGB")) / 255.0).astype(np.float32)


def scaled_down(scene: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Average areas of `factor` x `factor` pixels, which need not be whole."""
    if factor == 1.0:
        return scene
    for axis in (0, 1):
        count = int(scene.shape[axis] // factor)
        total = np.cumsum(scene, axis, dtype=np.float64)
        total = np.concatenate([np.zeros_like(np.take(total, [0], axis)), total], axis)
        edges = np.arange(count + 1) * factor
        whole = np.minimum(edges.astype(int), scene.shape[axis] - 1)
        shape = [-1 if k == axis else 1 for k in range(3)]
        part = (edges - whole).reshape(shape)
        at = np.take(total, whole, axis) * (1 - part) + np.take(total, whole + 1, axis) * part
        scene = (np.diff(at, axis=axis) / factor).astype(np.float32)
    return scene


def sharpness(scene: NDArray[np.float32]) -> float:
    """Energy of the sharpest tiles' second differences over that of their differences at twice the step."""
    green = np.sqrt(np.maximum(scene[..., 1], 0.0))
    fine = np.abs(green[:, 1:-1] * 2 - green[:, :-2] - green[:, 2:])[:, 1:-1]
    wide = np.abs(green[:, 2:-2] * 2 - green[:, :-4] - green[:, 4:])
    tile = 64
    rows, cols = (n // tile for n in wide.shape)
    parts = (v[: rows * tile, : cols * tile].reshape(rows, tile, cols, tile) for v in (fine, wide))
    energy = [np.square(part).swapaxes(1, 2).reshape(-1, tile * tile).mean(1) for part in parts]
    busy = energy[1] > np.quantile(energy[1], 0.7)
    return float(np.median(energy[0][busy] / energy[1][busy]))


def own_blur(scene: NDArray[np.floating], rng: np.random.Generator) -> tuple[float, float]:
    """Slope of a scene's power spectrum, and variance (px^2, per axis) of its own Gaussian blur.

    Of the busiest windows, log P = a - slope log f - 4 pi^2 variance f^2, by least squares over rings. Blur
    that scenes of training have is learned as theirs, and kernels come out too narrow by as much.
    """
    side = _SPECTRUM_SIDE
    window = np.outer(np.hanning(side), np.hanning(side))
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    edges = np.geomspace(0.035, 0.5, 13)
    ring = np.digitize(f, edges) - 1
    centre = np.array([f[ring == k].mean() for k in range(12)])
    logs = []
    for _ in range(40):
        crop = busiest(scene, side, rng, 3)[..., 1].astype(np.float32)
        power = np.square(np.abs(np.fft.rfft2((crop - crop.mean()) * window)))
        logs.append([np.log(power[ring == k].mean() + 1e-9) for k in range(12)])
    rows = np.stack([np.ones(12), -np.log(centre), -4 * np.pi**2 * centre**2], 1)
    rows = np.vstack([rows, [[0.0, _SLOPE_HELD, 0.0]]])
    fitted = np.linalg.lstsq(rows, np.append(np.mean(logs, 0), _SLOPE_HELD * _NATURAL_SLOPE), rcond=None)[0]
    return float(fitted[1]), max(float(fitted[2]), 0.0)


def busiest(
    scene: NDArray[np.floating], side: int, rng: np.random.Generator, tries: int
) -> NDArray[np.floating]:
    """Of some squares (side, side, 3) of a scene the one of most contrast that is hardly clipped."""
    best, value = scene[:side, :side], -np.inf
    for _ in range(tries):
        row, col = (int(rng.integers(0, n - side + 1)) for n in scene.shape[:2])
        crop = scene[row : row + side, col : col + side]
        green = crop[::3, ::3, 1].astype(np.float32)
        contrast = min(float(green.std() / (green.mean() + 0.02)), 1.0)
        contrast -= 3.0 * max(float((green > 0.97).mean()) - 0.01, 0.0)
        if contrast > value:
            best, value = crop, contrast
    return best


def build(
    folder: Path, sources: Iterator[Source], drawn: int = 8, side: int = 1100, seed: int = 7
) -> list[dict[str, object]]:
    """Write every scene at all scales as `folder/*.npy` (float16) with `index.json`; return the index."""
    folder.mkdir(parents=True, exist_ok=True)
    index: list[dict[str, object]] = []
    rng = np.random.default_rng(seed)

    def keep(name: str, scene: NDArray[np.float32], scale: float) -> None:
        if min(scene.shape[:2]) < 260:
            return
        file = f"{len(index):04d}.npy"
        np.save(folder / file, scene.astype(np.float16))
        slope, blur = own_blur(scene, rng)
        facts = {"file": file, "name": name, "scale": scale, "shape": scene.shape[:2]}
        index.append({**facts, "slope": slope, "blur": blur})

    for source in sources:
        if source.name in TEST_HALF:
            continue
        try:
            scene = linear(source.data)
        except OSError:  # a damaged file of a test collection
            continue
        if not source.ready:
            scene = scaled_down(scene, max(_LEAST_FACTOR, max(scene.shape[:2]) / _LONGEST))
        if min(scene.shape[:2]) < 400 or sharpness(scene) < _SHARPEST:
            continue
        for scale in _SCALES:
            keep(source.name, scaled_down(scene, scale), scale)
    for number in range(drawn):
        keep(f"leaves {number}", dead_leaves(side, side, rng).transpose(1, 2, 0), 1.0)
        keep(f"text {number}", text(np.empty((3, side, side), np.float32), rng).transpose(1, 2, 0), 1.0)
    write_atomically(folder / "index.json", json.dumps(index, indent=1).encode())
    return index
