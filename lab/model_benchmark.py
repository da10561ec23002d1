"""How well regressions predict the PSF where no sample was, on lenses of `draw_lens` whose kernels are known.

Models are fed with true kernels at the patches of n photos and asked at places in between and beyond.
Compared with two ways of the trade: linear interpolation between PSFs of the image plane, which is what
efficient filter flow does, and a polynomial of the place for each pixel, as PSFEx fits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import cKDTree

from lab import page
from lab.kernels import distance
from lensmodel.core.errors import InvalidInputError, NoSamplesError
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.psf import PsfSample, as_kernel, centred
from lensmodel.core.types import (
    ZONES,
    FieldPosition,
    Kernel,
    LensSettings,
    StepHook,
    Zone,
    ignore_step,
)
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model import variables as va
from lensmodel.model.answer import MODES
from lensmodel.model.bandwidths import reference_bandwidth
from lensmodel.simulate import draw_lens

FRAME = Frame(2832, 4256)  # 12 megapixels, 3:2 (chosen)
PATCHES = (4, 6)  # rows and columns: 24 patches, as a calibration has in one photo
SIZE = 31  # pixels: that of an estimate
MARGIN_PX = 96  # half a window of a calibration: patches lie within the frame

Predictor = Callable[[FieldPosition], Kernel]
Fit = Callable[[Sequence[PsfSample]], Predictor]


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
    neighbours: int = 200  # k

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], *, neighbours: int = 200) -> PaperModel:
        """Build the tree; that is all the training there is."""
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        where = va.points(samples)
        varying = [c for c in (3, 4, 5, 6) if np.isfinite(where[:, c]).all() and np.ptp(where[:, c]) > 0]
        cloud, values = [], []
        for sample, row in zip(samples, where, strict=True):
            p = np.arange(sample.kernel.shape[0], dtype=np.float64) - sample.kernel.shape[0] // 2
            u, v = pixel_to_local(p[:, None], p[None, :], sample.position.phi)
            angle = sample.position.phi
            rest = np.concatenate([[row[0], np.cos(angle), np.sin(angle)], row[varying]])
            cloud.append(np.column_stack([u.ravel(), v.ravel(), np.tile(rest, (u.size, 1))]))
            values.append(sample.kernel.ravel())
        points = np.concatenate(cloud)
        d, n = 4 + len(varying), len(points)
        sigma = points.std(axis=0)
        sigma[3:5] = np.sqrt((sigma[3:5] ** 2).mean())  # one bandwidth for the circle
        scale = np.array([reference_bandwidth(max(float(s), 1e-6), d, n) for s in sigma])
        return cls(cKDTree(points / scale), np.concatenate(values), scale, tuple(varying), neighbours)

    def kernel_at_settings(self, position: FieldPosition, settings: LensSettings, size: int) -> Kernel:
        """Kernel of odd side `size` at a place, in the image frame; unknown settings count as 0."""
        t = np.arange(size, dtype=np.float64) - size // 2
        u, v = pixel_to_local(t[:, None], t[None, :], position.phi)
        row = np.nan_to_num(va.point(position, settings), nan=0.0)
        rest = np.concatenate([[row[0], np.cos(position.phi), np.sin(position.phi)], row[list(self.columns)]])
        asked = np.column_stack([u.ravel(), v.ravel(), np.tile(rest, (u.size, 1))]) / self.scale
        distance, index = self.tree.query(asked, k=min(self.neighbours, self.tree.n))
        near = np.exp(-0.5 * (distance**2 - (distance**2).min(axis=1, keepdims=True)))
        found = (near * self.values[index]).sum(axis=1) / near.sum(axis=1)
        return centred(found.reshape(size, size))


def patch_places(rng: np.random.Generator) -> list[FieldPosition]:
    """Draw one place in each cell of a 4 x 6 tiling: the 24 patches of a photo."""
    rows, cols = PATCHES
    found = []
    for i in range(rows):
        for j in range(cols):
            row = (i + rng.uniform(0.1, 0.9)) / rows * FRAME.height
            col = (j + rng.uniform(0.1, 0.9)) / cols * FRAME.width
            row = min(max(row, MARGIN_PX), FRAME.height - 1 - MARGIN_PX)
            col = min(max(col, MARGIN_PX), FRAME.width - 1 - MARGIN_PX)
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


def run_model_benchmark(
    *,
    seeds: Sequence[int] = (1000, 1001, 1002, 1003),
    photos: Sequence[int] = (1, 5),
    methods: Sequence[str] | None = None,
    on_step: StepHook = ignore_step,
) -> dict[str, Any]:
    """Compare methods of regression by the error of their predictions."""
    fits = _fits(methods)
    collected: dict[tuple[str, int], list[list[tuple[Zone, float]]]] = {}
    seconds: dict[tuple[str, int], float] = {}
    done, total = 0, len(seeds) * len(photos) * len(fits)
    on_step(done, total)
    for seed in seeds:
        lens = draw_lens(seed)
        rng = np.random.default_rng(seed)
        samples = [
            PsfSample(lens.kernel(place, None, SIZE), place, photo=f"photo{i}")
            for i in range(max(photos))
            for place in patch_places(rng)
        ]
        truth = [(place, lens.kernel(place, None, SIZE)) for place in asked_places()]
        for count in photos:
            names = {f"photo{i}" for i in range(count)}
            seen = [s for s in samples if s.photo in names]
            for name, fit in fits.items():
                start = time.process_time()
                predict = fit(seen)
                found = [(zone_of(p.r), distance(predict(p), k).rel_l2) for p, k in truth]
                seconds[name, count] = seconds.get((name, count), 0.0) + time.process_time() - start
                collected.setdefault((name, count), []).append(found)
                done += 1
                on_step(done, total)
    rows = [_row(*key, lenses, seconds[key]) for key, lenses in collected.items()]
    return {"seeds": list(seeds), "rows": rows}


def predictor(method: str, samples: Sequence[PsfSample]) -> Predictor:
    """Fit one of the methods of `run_model_benchmark` to samples; all of the same settings."""
    return _fits([method])[method](samples)


def _fits(methods: Sequence[str] | None) -> dict[str, Fit]:
    known: dict[str, Fit] = {
        "eff-linear": _linear,
        "polynomial": _polynomial,
        "paper": _paper,
        **{f"mode-{mode}": _regression(ModelSettings(mode=mode)) for mode in MODES},
    }
    unknown = [name for name in methods or () if name not in known]
    if unknown:
        raise InvalidInputError(f"no method {unknown[0]!r}; known: {', '.join(sorted(known))}")
    return {name: known[name] for name in methods or known}


def _regression(chosen: ModelSettings) -> Fit:
    def fit(samples: Sequence[PsfSample]) -> Predictor:
        model = LensModel.fit(samples, chosen)
        settings, size = samples[0].settings, samples[0].kernel.shape[0]
        return lambda place: model.query(place, settings, size).kernel

    return fit


def _paper(samples: Sequence[PsfSample]) -> Predictor:
    model = PaperModel.fit(samples)
    settings, size = samples[0].settings, samples[0].kernel.shape[0]
    return lambda place: model.kernel_at_settings(place, settings, size)


def _xy(places: Sequence[FieldPosition]) -> NDArray[np.float64]:
    return np.array([(p.r * math.cos(p.phi), p.r * math.sin(p.phi)) for p in places])


def _linear(samples: Sequence[PsfSample]) -> Predictor:
    """Linear interpolation of pixels between the PSFs of the image plane; the nearest outside."""
    where, values = _xy([s.position for s in samples]), np.stack([s.kernel for s in samples])
    inside, outside = LinearNDInterpolator(where, values), NearestNDInterpolator(where, values)

    def predict(place: FieldPosition) -> Kernel:
        found = inside(_xy([place]))[0]
        return as_kernel(np.maximum(found if np.isfinite(found).all() else outside(_xy([place]))[0], 0.0))

    return predict


def _polynomial(samples: Sequence[PsfSample]) -> Predictor:
    """Polynomial of degree 3 in the place for each pixel, least squares with a small ridge."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]

    def features(where: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([where[:, 0] ** i * where[:, 1] ** j for i, j in powers], axis=1)

    design = features(_xy([s.position for s in samples]))
    values = np.stack([s.kernel.ravel() for s in samples])
    size = samples[0].kernel.shape[0]
    solved = np.linalg.solve(design.T @ design + 1e-3 * np.eye(len(powers)), design.T @ values)
    return lambda place: as_kernel(np.maximum(features(_xy([place])) @ solved, 0.0).reshape(size, size))


def _row(
    name: str, photos: int, lenses: Sequence[Sequence[tuple[Zone, float]]], seconds: float
) -> dict[str, Any]:
    """Mean relative L2 by zone of a method, each lens counting the same."""
    errors = {
        zone: float(np.mean([np.mean([error for z, error in own if z == zone]) for own in lenses]))
        for zone in ZONES
    }
    return {"method": name, "photos": photos, "errors": errors, "seconds": round(seconds, 2)}


def table(result: Mapping[str, Any]) -> str:
    """Write the rows of a result as a Markdown table."""
    ordered = sorted(result["rows"], key=lambda row: (row["photos"], row["errors"]["corner"]))
    rows = [
        [
            row["method"],
            str(row["photos"]),
            *(f"{v:.3f}" for v in row["errors"].values()),
            f"{row['seconds']:.1f}",
        ]
        for row in ordered
    ]
    return page.table(["method", "photos", *ZONES, "CPU s"], rows)
