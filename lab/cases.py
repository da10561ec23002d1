"""The benchmark's cases: which photo, which PSF, which window, and its noise."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NoUsablePatchesError
from lensmodel.core.types import Kernel, NoiseModel, Plane, Planes
from lensmodel.patches import Patch, select
from lensmodel.simulate import DEMO_SCENES, demo_data_path, load_scene

Half: TypeAlias = Literal["dev", "test", "all"]

DATA: Final = Path(__file__).parent / "data"
WHITE: Final = 0.9  # level of a scene's 99.5 percentile

_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}


@dataclass(frozen=True, slots=True)
class BlindCase:
    """One question: a photo, a PSF and a noise level."""

    photo: Path
    psf_number: int  # row of the PSF file
    noise: float  # standard deviation as a share of full range
    patch: int  # side of a window in pixels
    seed: int  # for the noise
    # which window of the photograph: 0 is the best one that the selector finds, 1 the next beside it
    window: int = 0

    @property
    def name(self) -> str:
        """Short name of photo, window and PSF."""
        which = f"+{self.window}" if self.window else ""
        return f"{self.photo.stem}{which}/psf{self.psf_number:02d}"


class Observation(NamedTuple):
    """What an estimator is shown, and what the judge knows: a blurred, noisy window and its truth."""

    patch: Plane
    noise: NoiseModel
    sharp: Plane


def load_psfs() -> NDArray[np.float64]:
    """Read the twelve PSFs `(n, k, k)` of the benchmark."""
    with np.load(DATA / "lens_psfs.npz", allow_pickle=False) as stored:
        return np.stack([psf.centred(kernel) for kernel in stored["psf"]])


def list_photos(folder: Path | None = None) -> tuple[Path, ...]:
    """Photos of a folder by name; the library's own photographs when no folder is given."""
    if folder is None:
        return tuple(demo_data_path(f"{name}.jpg") for name in DEMO_SCENES)
    if not folder.is_dir():
        raise InvalidInputError(f"no folder {folder}; give one that holds sharp photographs")
    found = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES))
    if not found:
        raise InvalidInputError(f"{folder} holds no PNG, JPEG or TIFF file")
    return found


_SPLIT: Final[dict[str, dict[str, list[str | int]]]] = json.loads(
    (DATA / "split.json").read_text(encoding="utf-8")
)


def photo_half(stem: str) -> Half:
    """Half of the split that a photo belongs to; photos not listed go by the hash of their name."""
    return _half("photos", stem, hashlib.sha256(stem.encode()).digest()[0])


def psf_half(number: int) -> Half:
    """Half of the split that a PSF belongs to; numbers not listed go by parity."""
    return _half("psfs", number, number)


def _half(kind: str, name: str | int, chance: int) -> Half:
    if name in _SPLIT[kind]["test"]:
        return "test"
    return "dev" if name in _SPLIT[kind]["dev"] or chance % 2 == 0 else "test"


def make_cases(
    photos: tuple[Path, ...],
    psf_count: int,
    *,
    half: Half,
    noise: float,
    patch: int,
    seed: int,
    limit: int | None,
    scenes: int | None = None,
) -> tuple[BlindCase, ...]:
    """Every scene with every PSF of a half; at most `limit`, spread over both by a seeded shuffle."""
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
        BlindCase(own[i % len(own)], n, noise, patch, seed, window=i // len(own))
        for i, n in (pairs[int(at)] for at in np.sort(chosen))
    )


def _spread(pairs: list[tuple[int, int]], order: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """Take pairs so that photos and PSFs appear about equally often."""
    photos: Counter[int] = Counter()
    psfs: Counter[int] = Counter()
    left, taken = [int(at) for at in order], list[int]()
    while left and len(taken) < limit:
        at = min(left, key=lambda a: photos[pairs[a][0]] + psfs[pairs[a][1]])
        left.remove(at)
        taken.append(at)
        photos[pairs[at][0]] += 1
        psfs[pairs[at][1]] += 1
    return np.array(taken, dtype=np.int64)


@lru_cache(maxsize=3)
def scene_of(photo: Path) -> Planes:
    """A photo as linear light, scaled so that the 99.5 percentile of green lies at 0.9, clipped at 1."""
    planes = load_scene(photo)
    scale = WHITE / max(float(np.percentile(planes[1], 99.5)), 1e-3)
    scene: Planes = np.minimum(planes * np.float32(scale), np.float32(1.0))
    return scene


def observe(case: BlindCase, kernel: Kernel) -> Observation:
    """Blur the photograph by valid convolution, add noise, and take a window that the selector finds."""
    size, margin = case.patch, kernel.shape[0] // 2
    again = [case.window] if case.window else []
    rng = np.random.default_rng([case.seed, case.psf_number, 0, _number(case.photo.stem), *again])
    green = scene_of(case.photo)[1]
    blurred = signal.fftconvolve(green.astype(np.float64), kernel, mode="valid")
    plane = (blurred + rng.normal(0.0, case.noise, blurred.shape)).astype(np.float32)
    noise, (height, width) = NoiseModel.white(case.noise), plane.shape
    try:
        found = select(plane, noise, size=size)
    except NoUsablePatchesError:  # the middle of the frame, lest a method profits from the refusal
        row, col = (height - size) // 2, (width - size) // 2
    else:
        best = _apart(sorted(found.patches, key=lambda patch: -patch.score), case.window)
        row, col, size = best.row, best.col, best.size
    sharp = green[margin + row : margin + row + size, margin + col : margin + col + size]
    patch = np.ascontiguousarray(plane[row : row + size, col : col + size])
    return Observation(patch, noise, np.ascontiguousarray(sharp))


def _apart(patches: Sequence[Patch], number: int) -> Patch:
    """Return patch `number` of those that overlap none before them, and then of the rest in turn."""
    apart: list[Patch] = []
    for patch in patches:
        gaps = [max(abs(patch.row - other.row), abs(patch.col - other.col)) for other in apart]
        if all(gap >= patch.size for gap in gaps):
            apart.append(patch)
    rest = [patch for patch in patches if patch not in apart]
    return [*apart, *rest][number % len(patches)]


def _number(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
