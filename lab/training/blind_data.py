"""Make what the blind benchmark and its methods read; each writes a file of `lab/data`.

    python -m lab.training.blind_data psfs
    python -m lab.training.blind_data edges
    python -m lab.training.blind_data mixture FOLDER NAME...

`psfs` are corners of simulated lenses of different character: the benchmark reads the stored file, so that
results stay comparable when the simulator changes. `edges` is the prior of the estimator `sun`: windows of
ideal edges, and how steep those of dead-leaves scenes are. `mixture` is the judge's, fitted to photographs by
the stems of their names; the shipped one to development photographs only.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.blind.methods.sun import SIDE, edge_mask, steepness_of
from lab.blind.steps.pyramid import View
from lab.cases import DATA, WHITE
from lab.scenes import dead_leaves
from lensmodel.core import psf
from lensmodel.core.types import FieldPosition, Kernel, LensSettings, NoiseModel
from lensmodel.simulate import draw_lens, load_scene

PSF_SIZE: Final = 55  # pixels of a kernel: the largest that the paper estimates
FIRST_SEED: Final = 5000  # apart from the seeds of other commands (chosen)
COPIES: Final = 24
"""So many copies of each kind are looked at for the one whose corner comes nearest to the width."""


class Wanted(NamedTuple):
    """One PSF to make: kind of lens, place in the field, RMS width per axis in pixels, pixel pitch."""

    kind: str
    r: float
    phi_degrees: float
    width_px: float
    pitch_um: float = 4.5


WANTED: Final = (
    Wanted("nearly-perfect", 0.95, 35.0, 0.8),
    Wanted("tilted", 0.70, 145.0, 1.0),
    Wanted("field-curvature", 0.85, -150.0, 1.3),
    Wanted("zoom", 0.80, -30.0, 1.5),
    Wanted("coma", 0.95, 33.0, 1.8),
    Wanted("decentred", 0.90, 147.0, 2.0),
    Wanted("astigmatism", 0.92, -145.0, 2.3),
    Wanted("soft-fast", 0.75, -40.0, 2.6),
    Wanted("coma", 0.97, 150.0, 3.0, 4.0),
    Wanted("astigmatism", 0.95, 30.0, 3.5, 3.5),
    Wanted("soft-fast", 0.90, -33.0, 4.2, 3.8),
    Wanted("soft-fast", 0.97, -147.0, 5.0, 3.5),
)
"""From sharp to soft, of lenses of different character (chosen)."""


def psf_of(wanted: Wanted) -> tuple[Kernel, str]:
    """Find the copy whose green PSF at the place comes nearest to the wanted width; also say what it is."""
    place, found = FieldPosition(wanted.r, math.radians(wanted.phi_degrees)), []
    for seed in range(FIRST_SEED, FIRST_SEED + COPIES):
        lens = draw_lens(seed, wanted.kind)
        widest = lens.f_number(LensSettings())
        settings = LensSettings(aperture=widest, channel="g")
        kernel = psf.centred(lens.kernel(place, settings, size=PSF_SIZE, pitch_um=wanted.pitch_um))
        found.append((abs(math.log(psf.rms_width(kernel) / wanted.width_px)), seed, widest, kernel))
    _, seed, f_number, kernel = min(found, key=lambda copy: copy[:2])
    facts = (
        f"kind {wanted.kind}, seed {seed}, f_number {f_number}, r {wanted.r}, "
        f"phi_degrees {wanted.phi_degrees}, pitch_um {wanted.pitch_um}, "
        f"width_px {round(psf.rms_width(kernel), 3)}"
    )
    return kernel, facts


COUNT: Final = 220  # windows of the prior (chosen)
ANGLES: Final = 32  # of edges in a turn (chosen)
SCENES: Final = 6  # of dead leaves (chosen)
QUANTILES: Final = 64  # of the steepness (chosen)

_FINE = 8  # samples a pixel along each axis (chosen)


def primitives() -> NDArray[np.float64]:
    """Windows `(n, SIDE²)` of steps, bars and corners, zero mean, unit norm."""
    t = (np.arange(SIDE * _FINE) + 0.5) / _FINE - SIDE / 2.0
    down, across = t[:, None], t[None, :]
    drawn = []
    # A quarter of the circle is enough: every window comes with its turns.
    for angle in np.arange(ANGLES // 4) * 2.0 * math.pi / ANGLES:
        u = math.cos(angle) * across - math.sin(angle) * down
        v = math.sin(angle) * across + math.cos(angle) * down
        for place in (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5):
            drawn.append(u > place)
            drawn.extend((u > place) & (u < place + width) for width in (1.0, 2.0))
            drawn.extend((u > place) & (v > other) for other in (-1.0, 0.0, 1.0))
    fine = np.stack(drawn).astype(np.float64)
    pixels = fine.reshape(len(fine), SIDE, _FINE, SIDE, _FINE).mean(axis=(2, 4)).reshape(len(fine), -1)
    pixels -= pixels.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(pixels, axis=1)
    strong = norm > 0.2 * norm.max()
    return np.asarray(pixels[strong] / norm[strong, None])


def spread(windows: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Pick windows far from each other, each with its turns by 90 degrees and its negative."""
    chosen: list[NDArray[np.float64]] = []
    nearest = np.full(len(windows), -1.0)
    pick = 0
    while len(chosen) < count:
        square = windows[pick].reshape(SIDE, SIDE)
        orbit = [s * np.rot90(square, turn).ravel() for turn in range(4) for s in (1.0, -1.0)]
        for one in orbit:
            if all(float(one @ other) < 1.0 - 1e-6 for other in chosen):
                chosen.append(one)
                nearest = np.maximum(nearest, windows @ one)
        pick = int(nearest.argmin())
    return np.stack(chosen)


def steepness() -> NDArray[np.float64]:
    """Quantiles of the steepness of edge windows in sharp scenes."""
    found = []
    for seed in range(SCENES):
        plane = dead_leaves(256, 256, np.random.default_rng(seed), largest=60.0)[1]
        view = View.of(plane.astype(np.float32), NoiseModel.white(0.0))
        found.append(steepness_of(view.y)[edge_mask(view.y)])
    return np.quantile(np.concatenate(found), (np.arange(QUANTILES) + 0.5) / QUANTILES)


WINDOW: Final = 8  # pixels of a window, as in the paper


def windows_of(photo: Path, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Random windows of one photo's green plane, zero-mean, `(count, WINDOW²)`."""
    plane = load_scene(photo)[1]
    plane = plane * np.float32(WHITE / max(float(np.percentile(plane, 99.5)), 1e-3))
    view = np.lib.stride_tricks.sliding_window_view(plane, (WINDOW, WINDOW))
    at = rng.integers(0, (view.shape[0], view.shape[1]), size=(4 * count, 2))
    windows = view[at[:, 0], at[:, 1]].reshape(-1, WINDOW * WINDOW).astype(np.float32)
    windows = windows[windows.max(axis=1) < 1.0]
    windows = windows - windows.mean(axis=1, keepdims=True)
    contrast = windows.std(axis=1) + 1e-4
    drawn = rng.choice(len(windows), count // 2, replace=False, p=contrast / contrast.sum())
    return np.concatenate([windows[: count - count // 2], windows[drawn]])


def train_epll(
    photos: Sequence[Path], out: Path, *, components: int = 40, windows: int = 30_000, seed: int = 0
) -> None:
    """Fit the mixture by expectation maximisation and write it; needs scikit-learn."""
    from sklearn.mixture import GaussianMixture  # noqa: PLC0415 - needed for training only

    rng = np.random.default_rng(seed)
    data = np.concatenate([windows_of(photo, windows // len(photos), rng) for photo in photos])
    model = GaussianMixture(
        components,
        means_init=np.zeros((components, WINDOW * WINDOW)),
        init_params="kmeans",
        reg_covar=1e-7,
        tol=2e-2,
        max_iter=12,
        random_state=seed,
    ).fit(data.astype(np.float64))
    # The windows have no mean of their own and neither have the components: it goes into the spread.
    covariances = model.covariances_ + np.einsum("mi,mj->mij", model.means_, model.means_)
    at = np.tril_indices(WINDOW * WINDOW)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        out,
        weights=model.weights_.astype(np.float32),
        covariances=covariances[:, at[0], at[1]].astype(np.float32),
    )


def main() -> None:
    """Write one of the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=["psfs", "edges", "mixture"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    if asked.what == "psfs":
        kernels, facts = zip(*map(psf_of, WANTED), strict=True)
        np.savez_compressed(DATA / "lens_psfs.npz", psf=np.stack(kernels), facts=np.array(facts))
    elif asked.what == "edges":
        patches, steep = (a.astype(np.float32) for a in (spread(primitives(), COUNT), steepness()))
        np.savez_compressed(DATA / "edge_patches.npz", patches=patches, steepness=steep)
    else:
        photos = sorted(path for path in asked.folder.iterdir() if path.stem in asked.names)
        train_epll(photos, DATA / "epll.npz")


if __name__ == "__main__":
    main()
