"""How well regressions predict the PSF where no sample was, on lenses whose kernels are known.

Models are fed with true kernels at the patches of n photos and asked at places in between and beyond.
Compared with two ways of the trade: linear interpolation between PSFs of the image plane, which is what
efficient filter flow does, and a polynomial of the place for each pixel, as PSFEx fits.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import cKDTree

from lab import page
from lab.kernels import distance
from lensmodel.core.errors import InvalidInputError, NoSamplesError
from lensmodel.core.psf import PsfField, PsfSample, as_kernel, centred
from lensmodel.core.types import (
    ZONES,
    FieldPosition,
    Frame,
    Kernel,
    LensSettings,
    StepHook,
    ignore_step,
    zone_of,
)
from lensmodel.model import LensModel, query
from lensmodel.model.bandwidths import reference_bandwidth
from lensmodel.model.query import MODES
from lensmodel.simulate import draw_lens

FRAME: Final = Frame(2832, 4256)  # 12 megapixels, 3:2 (chosen)
PATCHES: Final = (4, 6)  # rows and columns: 24 patches, as a calibration has in one photo
SIZE: Final = 31  # pixels: that of an estimate
MARGIN_PX: Final = 96  # half a window of a calibration: patches lie within the frame
NEIGHBOURS: Final = 200  # k of the paper's form

Predictor = Callable[[FieldPosition], Kernel]
Fit = Callable[[PsfField, Sequence[PsfSample]], Predictor]  # of the true field, and samples of it


def pixel_to_local(
    drow: NDArray[np.floating] | float, dcol: NDArray[np.floating] | float, phi: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn pixel offsets into (u, v): dcol cos phi - drow sin phi, and -dcol sin phi - drow cos phi."""
    a, b = np.asarray(dcol, dtype=np.float64), -np.asarray(drow, dtype=np.float64)
    c, s = math.cos(phi), math.sin(phi)
    return a * c + b * s, b * c - a * s


@dataclass(frozen=True, slots=True, eq=False)
class PaperModel:
    """The paper's regression: a flat cloud of pixels, eq. (8) to the letter, k nearest points."""

    tree: cKDTree  # points (u, v, r, cos phi, sin phi, Phi) in bandwidths
    values: NDArray[np.float64]  # intensity of each point
    scale: NDArray[np.float64]  # bandwidths of the columns
    columns: tuple[int, ...]  # which settings vary and take part

    @classmethod
    def fit(cls, samples: Sequence[PsfSample]) -> PaperModel:
        """Build the tree; that is all the training there is."""
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        where = query.points(samples)
        varying = tuple(c for c in (3, 4, 5, 6) if np.isfinite(where[:, c]).all() and np.ptp(where[:, c]) > 0)
        points = np.concatenate(
            [_cloud(s.position, row, varying, len(s.kernel)) for s, row in zip(samples, where, strict=True)]
        )
        sigma = points.std(axis=0)
        sigma[3:5] = np.sqrt((sigma[3:5] ** 2).mean())  # one bandwidth for the circle
        dimensions = 4 + len(varying)
        scale = np.array([reference_bandwidth(max(float(s), 1e-6), dimensions, len(points)) for s in sigma])
        return cls(
            cKDTree(points / scale), np.concatenate([s.kernel.ravel() for s in samples]), scale, varying
        )

    def kernel_at_settings(self, position: FieldPosition, settings: LensSettings, size: int) -> Kernel:
        """Kernel of odd side `size` at a place, in the image frame; unknown settings count as 0."""
        row = np.nan_to_num(query.point(position, settings), nan=0.0)
        asked = _cloud(position, row, self.columns, size) / self.scale
        distance, index = self.tree.query(asked, k=min(NEIGHBOURS, self.tree.n))
        near = np.exp(-0.5 * (distance**2 - (distance**2).min(axis=1, keepdims=True)))
        found = (near * self.values[index]).sum(axis=1) / near.sum(axis=1)
        return centred(found.reshape(size, size))


def _cloud(
    place: FieldPosition, row: NDArray[np.float64], columns: Sequence[int], size: int
) -> NDArray[np.float64]:
    """Points (u, v, r, cos phi, sin phi, Phi) of the pixels of a kernel."""
    t = np.arange(size, dtype=np.float64) - size // 2
    u, v = pixel_to_local(t[:, None], t[None, :], place.phi)
    rest = np.concatenate([[row[0], np.cos(place.phi), np.sin(place.phi)], row[list(columns)]])
    return np.column_stack([u.ravel(), v.ravel(), np.tile(rest, (u.size, 1))])


def patch_places(rng: np.random.Generator) -> list[FieldPosition]:
    """Draw one place in each cell of a 4 x 6 tiling: the 24 patches of a photo."""
    found, sides = [], (FRAME.height, FRAME.width)
    for cell in np.ndindex(PATCHES):
        at = [(i + rng.uniform(0.1, 0.9)) / n * side for i, n, side in zip(cell, PATCHES, sides, strict=True)]
        row, col = (min(max(x, MARGIN_PX), side - 1 - MARGIN_PX) for x, side in zip(at, sides, strict=True))
        found.append(FRAME.position(float(row), float(col)))
    return found


def asked_places() -> list[FieldPosition]:
    """Places of the questions, all inside the frame: 12 at the centre, 8 mid, 12 in the corners."""
    rings: list[tuple[tuple[float, ...], tuple[float, ...]]] = [
        ((0.05, 0.15, 0.27), (-2.2, -0.6, 1.1, 2.6)),
        ((0.4, 0.6), (-2.7, -0.5, 0.4, 2.5)),
        ((0.8, 0.9), (-2.58, -0.52, 0.55, 2.62)),
        ((0.98,), (-2.55, -0.6, 0.58, 2.56)),
    ]
    return [FieldPosition(r, phi) for radii, angles in rings for r in radii for phi in angles]


def samples_of(truth: PsfField, seed: int, photos: int) -> list[PsfSample]:
    """Green kernels at the patches of some photos."""
    rng = np.random.default_rng(seed)
    return [
        PsfSample(truth.kernel_at(place, "g", SIZE), place, photo=f"photo{i}")
        for i in range(photos)
        for place in patch_places(rng)
    ]


def compared(
    truths: Sequence[tuple[int, PsfField]],
    fits: Mapping[str, Fit],
    photos: Sequence[int] = (1,),
    on_step: StepHook = ignore_step,
) -> list[dict[str, Any]]:
    """Mean relative L2 by zone of each method and number of photos, over lenses with seeds of patches."""
    collected: dict[tuple[str, int, str], list[float]] = defaultdict(list)
    seconds: dict[tuple[str, int], float] = defaultdict(float)
    done, total = 0, len(truths) * len(photos) * len(fits)
    on_step(done, total)
    for seed, truth in truths:
        samples = samples_of(truth, seed, max(photos))
        asked = [(place, truth.kernel_at(place, "g", SIZE)) for place in asked_places()]
        for count in photos:
            known = samples[: count * math.prod(PATCHES)]
            for name, fit in fits.items():
                start = time.process_time()
                predict = fit(truth, known)
                for place, kernel in asked:
                    found = distance(predict(place), kernel).rel_l2
                    collected[name, count, zone_of(place.r)].append(found)
                seconds[name, count] += time.process_time() - start
                done += 1
                on_step(done, total)
    return [
        {
            "method": name,
            "photos": count,
            "errors": {zone: float(np.mean(collected[name, count, zone])) for zone in ZONES},
            "seconds": spent,
        }
        for (name, count), spent in seconds.items()
    ]


def run_model_benchmark(
    *,
    seeds: Sequence[int] = (1000, 1001, 1002, 1003),
    photos: Sequence[int] = (1, 5),
    methods: Sequence[str] | None = None,
    on_step: StepHook = ignore_step,
) -> list[dict[str, Any]]:
    """Compare methods of regression on lenses of `draw_lens`, see `compared`."""
    unknown = [name for name in methods or () if name not in FITS]
    if unknown:
        raise InvalidInputError(f"no method {unknown[0]!r}; known: {', '.join(sorted(FITS))}")
    fits = {name: FITS[name] for name in methods or FITS}
    return compared([(seed, draw_lens(seed).field()) for seed in seeds], fits, photos, on_step)


def _regression(mode: str) -> Fit:
    def fit(_: PsfField, samples: Sequence[PsfSample]) -> Predictor:
        model, settings = LensModel.fit(samples, mode), samples[0].settings
        return lambda place: model.query(place, settings, SIZE).kernel

    return fit


def _paper(_: PsfField, samples: Sequence[PsfSample]) -> Predictor:
    model, settings = PaperModel.fit(samples), samples[0].settings
    return lambda place: model.kernel_at_settings(place, settings, SIZE)


def _xy(places: Sequence[FieldPosition]) -> NDArray[np.float64]:
    return np.array([(p.r * math.cos(p.phi), p.r * math.sin(p.phi)) for p in places])


def _linear(_: PsfField, samples: Sequence[PsfSample]) -> Predictor:
    """Linear interpolation of pixels between the PSFs of the image plane; the nearest outside."""
    where, values = _xy([s.position for s in samples]), np.stack([s.kernel for s in samples])
    inside, outside = LinearNDInterpolator(where, values), NearestNDInterpolator(where, values)

    def predict(place: FieldPosition) -> Kernel:
        found = inside(_xy([place]))[0]
        return as_kernel(np.maximum(found if np.isfinite(found).all() else outside(_xy([place]))[0], 0.0))

    return predict


def _polynomial(_: PsfField, samples: Sequence[PsfSample]) -> Predictor:
    """Polynomial of degree 3 in the place for each pixel, least squares with a small ridge."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]

    def features(where: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([where[:, 0] ** i * where[:, 1] ** j for i, j in powers], axis=1)

    design = features(_xy([s.position for s in samples]))
    values = np.stack([s.kernel.ravel() for s in samples])
    solved = np.linalg.solve(design.T @ design + 1e-3 * np.eye(len(powers)), design.T @ values)
    return lambda place: as_kernel(np.maximum(features(_xy([place])) @ solved, 0.0).reshape(SIZE, SIZE))


FITS: Final[Mapping[str, Fit]] = {
    "eff-linear": _linear,
    "polynomial": _polynomial,
    "paper": _paper,
    **{f"mode-{mode}": _regression(mode) for mode in MODES},
}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write the rows of a comparison as a Markdown table."""
    ordered = sorted(rows, key=lambda row: (row["photos"], row["errors"]["corner"]))
    cells = [
        [
            row["method"],
            str(row["photos"]),
            *(f"{row['errors'][zone]:.3f}" for zone in ZONES),
            f"{row['seconds']:.1f}",
        ]
        for row in ordered
    ]
    return page.table(["method", "photos", *ZONES, "CPU s"], cells)
