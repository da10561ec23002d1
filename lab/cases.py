"""The benchmark's cases: which photo, which PSF, which window, what the camera makes of it."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import signal

from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NoUsablePatchesError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import Kernel, NoiseModel, Plane, Planes, ignore_step
from lensmodel.estimation.patches import Patch, select
from lensmodel.estimation.patches.blocks import BLOCKS_A_SIDE, measure_blocks
from lensmodel.estimation.patches.select import edge_score, first_reasons
from lensmodel.estimation.patches.windows import windows_of
from lensmodel.simulate import DEMO_SCENES, demo_data_path, load_scene, srgb_to_linear

Half: TypeAlias = Literal["dev", "test", "all"]
Variant: TypeAlias = Literal["gaussian", "bayer", "jpeg"]
Choice: TypeAlias = Literal["random", "r-map", "good-regions"]
HALVES: Final = ("dev", "test", "all")
VARIANTS: Final = ("gaussian", "bayer", "jpeg")
CHOICES: Final = ("random", "r-map", "good-regions")

DATA: Final = Path(__file__).parent / "data"
WHITE: Final = 0.9
"""Level of a scene's 99.5 percentile."""

JPEG_QUALITY: Final = 90  # of the camera (chosen)
_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
_CHOICE_SIGMA = 0.01  # noise by which windows are ranked: that of most cases (chosen)


@dataclass(frozen=True, slots=True)
class BlindCase:
    """One question: a photo, a PSF and a noise level.

    Parameters
    ----------
    photos : tuple of Path
        One window comes from each; the first is the one that is deblurred, the others are pooled.
    psf_number : int
        Row of the PSF file.
    noise : float
        Standard deviation as a share of full range.
    patch : int
        Side of a window in pixels.
    variant : {"gaussian", "bayer", "jpeg"}
        What the camera does: nothing but noise; a Bayer mosaic, interpolated; sRGB and JPEG.
    seed : int
        For the choice of windows and the noise.
    choice : {"random", "r-map", "good-regions"}
        Who chooses the windows: chance, from the better half of them by the sharp scene; or a selector of
        `lensmodel.estimation.patches`, which sees the blurred and noisy photograph only.
    window : int
        Which window of each photograph: 0 is the best one that a selector finds, 1 the next beside it.
    """

    photos: tuple[Path, ...]
    psf_number: int
    noise: float
    patch: int
    variant: Variant
    seed: int
    choice: Choice = "random"
    window: int = 0

    @property
    def name(self) -> str:
        """Short name of photo, window and PSF."""
        which = f"+{self.window}" if self.window else ""
        return f"{self.photos[0].stem}{which}/psf{self.psf_number:02d}"


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What an estimator is shown, and what the judge knows.

    Parameters
    ----------
    patches : tuple of Plane
        Blurred and noisy windows, each `(P, P)`.
    noise : NoiseModel
        Of every patch.
    sharp : Plane, shape (P, P)
        The truth behind the first patch.
    kernel : Kernel
        The true PSF.
    """

    patches: tuple[Plane, ...]
    noise: NoiseModel
    sharp: Plane
    kernel: Kernel


def load_psfs(path: Path | None = None) -> NDArray[np.float64]:
    """Read PSFs, key `psf`, `(n, k, k)`; our own twelve when no path is given.

    Raises
    ------
    InvalidInputError
        If the file has no such array.
    """
    source = path or DATA / "lens_psfs.npz"
    try:
        with np.load(source, allow_pickle=False) as stored:
            kernels = np.asarray(stored["psf"], dtype=np.float64)
    except (OSError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{source} holds no array 'psf' of shape (n, k, k)") from error
    if kernels.ndim != 3:
        raise InvalidInputError(f"'psf' of {source} must have three axes (n, k, k), got {kernels.shape}")
    return np.stack([psf.centred(kernel) for kernel in kernels])


def list_photos(folder: Path | None = None) -> tuple[Path, ...]:
    """Photos of a folder by name; the library's own photographs when no folder is given.

    Raises
    ------
    InvalidInputError
        If the folder holds none.
    """
    if folder is None:
        return tuple(demo_data_path(f"{name}.jpg") for name in DEMO_SCENES)
    if not folder.is_dir():
        raise InvalidInputError(f"no folder {folder}; give one that holds sharp photographs")
    found = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES))
    if not found:
        raise InvalidInputError(f"{folder} holds no PNG, JPEG or TIFF file")
    return found


def _split() -> dict[str, dict[str, list[str | int]]]:
    split: dict[str, dict[str, list[str | int]]] = json.loads(
        (DATA / "split.json").read_text(encoding="utf-8")
    )
    return split


def photo_half(stem: str) -> Half:
    """Half of the split that a photo belongs to; photos not listed go by the hash of their name."""
    split = _split()["photos"]
    for half in ("dev", "test"):
        if stem in split[half]:
            return "dev" if half == "dev" else "test"
    return "dev" if hashlib.sha256(stem.encode()).digest()[0] % 2 == 0 else "test"


def psf_half(number: int) -> Half:
    """Half of the split that a PSF belongs to; numbers not listed go by parity."""
    split = _split()["psfs"]
    if number in split["test"]:
        return "test"
    return "dev" if number in split["dev"] or number % 2 == 0 else "test"


def make_cases(
    photos: tuple[Path, ...],
    psf_count: int,
    *,
    half: Half,
    noise: float,
    patch: int,
    variant: Variant,
    pool: int,
    seed: int,
    limit: int | None,
    choice: Choice = "random",
    scenes: int | None = None,
) -> tuple[BlindCase, ...]:
    """Every scene with every PSF of a half; at most `limit`, spread over both by a seeded shuffle.

    A scene is a window of a photo: one of each, or `scenes` of all in turn. With `pool` > 1 the further
    windows come from the other photos of the half, in turn: photos by the same lens, of other scenes.

    Raises
    ------
    InvalidInputError
        If the half has no photo or no PSF, or `scenes` is below one.
    """
    if scenes is not None and scenes < 1:
        raise InvalidInputError(f"a benchmark takes at least one scene, not {scenes}")
    own = [p for p in photos if half in {"all", photo_half(p.stem)}]
    numbers = [n for n in range(psf_count) if half in {"all", psf_half(n)}]
    if not own or not numbers:
        raise InvalidInputError(
            f"half {half!r} has {len(own)} photos and {len(numbers)} PSFs; give more, or use half 'all'"
        )
    pairs = [(i, n) for i in range(scenes or len(own)) for n in numbers]
    order = np.random.default_rng(seed).permutation(len(pairs))
    chosen = order if limit is None else _spread(pairs, order, limit)
    return tuple(
        BlindCase(
            tuple(own[(i + k) % len(own)] for k in range(pool)),
            *(n, noise, patch, variant, seed, choice),
            window=i // len(own),
        )
        for i, n in (pairs[int(at)] for at in np.sort(chosen))
    )


def _spread(pairs: list[tuple[int, int]], order: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """Take pairs so that photos and PSFs appear about equally often."""
    photos: dict[int, int] = {}
    psfs: dict[int, int] = {}
    left = [int(at) for at in order]
    taken: list[int] = []
    while left and len(taken) < limit:
        at = min(left, key=lambda a: photos.get(pairs[a][0], 0) + psfs.get(pairs[a][1], 0))
        left.remove(at)
        taken.append(at)
        photos[pairs[at][0]] = photos.get(pairs[at][0], 0) + 1
        psfs[pairs[at][1]] = psfs.get(pairs[at][1], 0) + 1
    return np.array(taken, dtype=np.int64)


@lru_cache(maxsize=3)
def scene_of(photo: Path) -> Planes:
    """A photo as linear light, scaled so that the 99.5 percentile of green lies at 0.9, clipped at 1."""
    planes = load_scene(photo)
    scale = WHITE / max(float(np.percentile(planes[1], 99.5)), 1e-3)
    scene: Planes = np.minimum(planes * np.float32(scale), np.float32(1.0))
    return scene


@lru_cache(maxsize=64)
def good_corners(photo: Path, patch: int, margin: int) -> tuple[tuple[int, int], ...]:
    """Corners of the windows with the better half of the edge scores, best first.

    The choice looks at the sharp scene only, so that it cannot favour a method.
    """
    green = scene_of(photo)[1]
    noise = NoiseModel.white(_CHOICE_SIGMA)
    inner = np.ascontiguousarray(green[margin:-margin, margin:-margin])
    if min(inner.shape) < patch:
        raise InvalidInputError(f"{photo.name} is too small for a patch of {patch} px and a PSF around it")
    blocks = measure_blocks(inner, noise, patch // BLOCKS_A_SIDE, 1.0, ignore_step)
    windows = windows_of(blocks, Frame(*inner.shape), noise)
    score = edge_score(windows)
    fine = first_reasons(windows, np.zeros(len(windows))) == ""
    order = [int(i) for i in np.lexsort((windows.cols, windows.rows, -score)) if fine[i] or not fine.any()]
    return tuple(
        (int(windows.rows[i]) + margin, int(windows.cols[i]) + margin) for i in order[: -(-len(order) // 2)]
    )


def observe(case: BlindCase, kernel: Kernel) -> Observation:
    """Make what the camera sees: blur by valid convolution, then noise, then the variant's camera."""
    patches = []
    sharp: Plane | None = None
    for turn, photo in enumerate(case.photos):
        again = [case.window] if case.window else []
        rng = np.random.default_rng([case.seed, case.psf_number, turn, _number(photo.stem), *again])
        scene, patch = (_drawn if case.choice == "random" else _chosen)(photo, kernel, case, rng)
        if turn == 0:
            sharp = np.ascontiguousarray(scene)
        patches.append(patch)
    assert sharp is not None
    return Observation(tuple(patches), NoiseModel.white(case.noise), sharp, kernel)


def _drawn(photo: Path, kernel: Kernel, case: BlindCase, rng: np.random.Generator) -> tuple[Plane, Plane]:
    """Sharp and photographed window, drawn by chance."""
    size, margin = case.patch, kernel.shape[0] // 2
    corners = good_corners(photo, size, margin)
    row, col = corners[int(rng.integers(len(corners)))]
    scene = scene_of(photo)[:, row - margin : row + size + margin, col - margin : col + size + margin]
    return scene[1, margin : margin + size, margin : margin + size], _photographed(scene, kernel, case, rng)


def _chosen(photo: Path, kernel: Kernel, case: BlindCase, rng: np.random.Generator) -> tuple[Plane, Plane]:
    """Sharp and photographed window, the best that a selector finds in the whole blurred photograph.

    The next ones are the best that overlap none before them; where all others do, the best of those.
    Selectors take smaller windows where the frame has not four of them on its shorter side. Where nothing is
    usable the middle of the frame is taken, lest a method profits from the refusal.
    """
    size, margin = case.patch, kernel.shape[0] // 2
    scene = scene_of(photo)
    plane = _photographed(scene, kernel, case, rng)
    height, width = plane.shape
    try:
        found = select(
            plane,
            NoiseModel.white(case.noise),
            Frame(height, width),
            size=size,
            selector=case.choice,
            jpeg=case.variant == "jpeg",
        )
    except NoUsablePatchesError:
        row, col = (height - size) // 2, (width - size) // 2
    else:
        best = _apart(sorted(found.patches, key=lambda patch: -patch.score), case.window)
        row, col, size = best.row, best.col, best.size
    sharp = scene[1, margin + row : margin + row + size, margin + col : margin + col + size]
    return sharp, np.ascontiguousarray(plane[row : row + size, col : col + size])


def _apart(patches: Sequence[Patch], number: int) -> Patch:
    """Return patch `number` of those that overlap none before them, and then of the rest in turn."""
    apart: list[Patch] = []
    for patch in patches:
        gaps = [max(abs(patch.row - other.row), abs(patch.col - other.col)) for other in apart]
        if all(gap >= patch.size for gap in gaps):
            apart.append(patch)
    rest = [patch for patch in patches if patch not in apart]
    return [*apart, *rest][number % len(patches)]


def _photographed(scene: Planes, kernel: Kernel, case: BlindCase, rng: np.random.Generator) -> Plane:
    def blurred(plane: Plane) -> NDArray[np.float64]:
        sharp = plane.astype(np.float64)
        return np.asarray(signal.fftconvolve(sharp, kernel, mode="valid"))

    if case.variant == "gaussian":
        green = blurred(scene[1])
        return (green + rng.normal(0.0, case.noise, green.shape)).astype(np.float32)
    light = np.stack([blurred(plane) for plane in scene])
    light = np.clip(light + rng.normal(0.0, case.noise, light.shape), 0.0, 1.0)
    if case.variant == "bayer":
        return _interpolated_green(light[1])
    return _through_jpeg(light)


def _interpolated_green(green: NDArray[np.float64]) -> Plane:
    """Keep green on the checkerboard of a Bayer mosaic and interpolate the rest bilinearly.

    The plainest demosaicing: what its low-pass does to the PSF is part of the question.
    """
    rows, cols = np.indices(green.shape)
    site = (rows + cols) % 2 == 1
    padded = np.pad(green, 1, mode="reflect")
    mean = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4.0
    return np.where(site, green, mean).astype(np.float32)


def _through_jpeg(light: NDArray[np.float64]) -> Plane:
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    pixels = np.rint(np.clip(coded, 0.0, 1.0) * 255.0).astype(np.uint8).transpose(1, 2, 0)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    with Image.open(buffer) as image:
        decoded = np.asarray(image.convert("RGB"))[..., 1]
    return srgb_to_linear(decoded.astype(np.float32) / np.float32(255.0))


def _number(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
