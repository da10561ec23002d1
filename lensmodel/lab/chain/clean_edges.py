r"""What clean edges of photographs tell of the light far from the core of the blur.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.clean_edges --photos 6 \
        --seeds 0 1 [--grids FILE.npz ...]

Power spectra confuse such light with the contrast of a scene. An edge between two even surfaces does not: on
both sides of it the light keeps rising or falling for as far as the blur reaches. Edges are taken where both
sides are even over 20 pixels, straight over 13, and no line; with p(t) the profile across one, what is
measured is

    A(d) = (p(d) - p(-d)) / (p(4) - p(-4)),

the share of the line spread function within d pixels over that within 4. Printed are, by zone, how many edges
there are in so many photos of how many scenes, the medians of A at some distances, and the same of the true
PSFs at the same places and angles. An edge of the scene can be soft, never sharper than a step: where the
photos show few things in focus, all of A is that of a wider blur.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel import photo
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.types import ZONES, FieldPosition, Kernel, Plane
from lensmodel.lab.chain.blind_gain import CAMERA, KnownLens, lenses, seed_range, shot, written

REACH, NEAR, ALONG = 20, 4, 6
"""Pixels: of a profile to either side, of the step that is compared with, of an edge to either side."""
SHOWN: Final = (2, 6, 8, 12, 16)
"""Distances that are printed, pixels."""

_SMOOTH, _AROUND, _APART = 1.5, 8.0, 7  # pixels: of the gradient, of the mean around, between edges (chosen)
_EVEN, _CONTRAST, _BRIGHTEST = 0.06, 0.25, 0.9  # of the step, of the mean, of full scale (chosen)
_MOST: Final = 6000  # candidates of a photo, the strongest (chosen)
_LINE = ((2, 0.0, 1.02), (3, 0.0, 1.02), (6, 0.98, np.inf))  # beyond these A is that of a line (chosen)
_FEWEST: Final = 8  # edges of a zone whose profiles are printed (chosen)
_SIDE: Final = 63  # pixels of a true kernel

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Edge:
    """A clean edge: where, the unit vector across it towards the light (right, down), A(1) to A(`REACH`)."""

    position: FieldPosition
    across: tuple[float, float]
    profile: Floats


def clean_edges(plane: Plane, frame: Frame) -> list[Edge]:
    """Find the clean edges of a plane, shape (h, w), in linear light of full scale 1."""
    values = plane.astype(np.float64)
    down, right = (ndimage.gaussian_filter(values, _SMOOTH, order=order) for order in ((1, 0), (0, 1)))
    strength = np.hypot(down, right) + 1e-12
    contrast = strength / (ndimage.gaussian_filter(values, _AROUND) + 0.01)
    rows, cols = np.nonzero(contrast == ndimage.maximum_filter(contrast, _APART))
    rim = REACH + ALONG + 2
    inside = (rows >= rim) & (cols >= rim) & (rows < plane.shape[0] - rim) & (cols < plane.shape[1] - rim)
    rows, cols = rows[inside], cols[inside]
    strongest = np.argsort(-contrast[rows, cols])[:_MOST]
    rows, cols = rows[strongest], cols[strongest]
    x, y = right[rows, cols] / strength[rows, cols], down[rows, cols] / strength[rows, cols]
    t = np.arange(-REACH, REACH + 1)
    tracks = np.stack(
        [
            ndimage.map_coordinates(
                values,
                [
                    rows[:, None] + y[:, None] * t + x[:, None] * s,
                    cols[:, None] + x[:, None] * t - y[:, None] * s,
                ],
                order=1,
            )
            for s in range(-ALONG, ALONG + 1, 2)
        ]
    )
    mean = tracks.mean(axis=0)
    step = np.maximum(mean[:, REACH + NEAR] - mean[:, REACH - NEAR], 1e-9)
    uneven = np.maximum(
        _unevenness(tracks[:, :, REACH + NEAR + 1 :]), _unevenness(tracks[:, :, : REACH - NEAR])
    )
    profiles = ((mean - mean[:, ::-1]) / step[:, None])[:, REACH + 1 :]
    good = (uneven < _EVEN * step) & (step > _CONTRAST * mean.mean(axis=1)) & (mean.max(axis=1) < _BRIGHTEST)
    for distance, least, most in _LINE:
        good &= (profiles[:, distance - 1] > least) & (profiles[:, distance - 1] < most)
    kept = np.flatnonzero(good)
    return [
        Edge(frame.position(float(rows[i]), float(cols[i])), (float(x[i]), float(y[i])), profiles[i])
        for i in kept
    ]


def _unevenness(side: Floats) -> Floats:
    """Scatter of one side about a straight line, and of its tracks about each other, shape (n,)."""
    t = np.arange(side.shape[2]) - (side.shape[2] - 1) / 2.0
    mean = side.mean(axis=2, keepdims=True)
    slope = (side * t).sum(axis=2, keepdims=True) / float((t**2).sum())
    about = ((side - mean - slope * t) ** 2).mean(axis=(0, 2))
    return np.asarray(np.sqrt(about + mean[..., 0].var(axis=0)))


def true_profile(kernel: Kernel, across: tuple[float, float]) -> Floats:
    """A(1) to A(`REACH`) of a kernel behind a step across a direction."""
    half = kernel.shape[0] // 2
    down, right = np.mgrid[-half : half + 1, -half : half + 1]
    fine = 0.25
    places = np.arange(-1.5 * half, 1.5 * half + fine / 2, fine)
    along = np.clip(right * across[0] + down * across[1], places[0], places[-1])
    bins = np.append(places - fine / 2, places[-1] + fine / 2)
    line = np.histogram(along.ravel(), bins, weights=kernel.ravel())[0]
    line = ndimage.uniform_filter1d(line, round(1.0 / fine), mode="constant")  # a pixel's own width
    middle = places[ndimage.gaussian_filter1d(line, _SMOOTH / fine).argmax()]
    d = np.arange(1, REACH + 1)
    within = np.interp(middle + d, places, line.cumsum()) - np.interp(middle - d, places, line.cumsum())
    return np.asarray(within / within[NEAR - 1])


def edges_of(lens: KnownLens, number: int) -> list[Edge]:
    """Clean edges of the green plane of a photo of a lens."""
    with tempfile.TemporaryDirectory() as folder:
        developed = photo.develop(written(Path(folder) / "photo.dng", shot(lens, number), tiff=False))
    return clean_edges(developed.planes[1], developed.frame)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, default=6)
    wanted = parser.parse_args()
    heads = " / ".join(f"A({d})" for d in SHOWN)
    print(f"| lens | zone | edges | scenes | true {heads} | seen |\n|---|---|---|---|---|---|")
    seeds = [seed for part in wanted.seeds for seed in part]
    for lens in lenses(seeds, wanted.grids, CAMERA.full_well_electrons):
        truth = lens.lens.field(lens.settings)
        photos = [edges_of(lens, number) for number in range(wanted.photos)]
        for zone in ZONES:
            own = [[edge for edge in edges if zone_of(edge.position.r) == zone] for edges in photos]
            kept = [edge for edges in own for edge in edges]
            scenes = sum(bool(edges) for edges in own)
            if len(kept) < _FEWEST:
                print(f"| {lens.name} | {zone} | {len(kept)} | {scenes} | - | - |", flush=True)
                continue
            true = [true_profile(truth.kernel_at(edge.position, "g", _SIDE), edge.across) for edge in kept]
            profiles = " | ".join(
                _words(np.median(rows, axis=0)) for rows in (true, [e.profile for e in kept])
            )
            print(f"| {lens.name} | {zone} | {len(kept)} | {scenes} | {profiles} |", flush=True)


def _words(profile: Floats) -> str:
    return " / ".join(f"{profile[d - 1]:.2f}" for d in SHOWN)


if __name__ == "__main__":
    main()
