"""Real photographs: what can be judged of a lens model without any truth.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.real_photos [--out FOLDER] [PHOTO ...]

For every photo, calibrated by itself; figures are of the green plane:

* odd and even patches: relative L2 between the PSFs of two halves of the patches of each cell;
* prediction: log likelihood of the spectra of patches under the PSFs of the model of *another* photo of
  the same camera, over that without blur and over that of the one Gaussian which suits the other photo
  best; in nats a patch, above 0 means that the model is better. Photos alone are compared with the model
  of their own other half;
* halos: how far the corrected photo leaves the range of the original beside strong edges, in percent of
  their step: a blurred thin line may do so rightly, so look at the crops as well;
* grain: noise in the flattest places after the correction over that before.

Crops of center and corners, before over after, go to FOLDER for the eye. The likelihood is Whittle's: the
spectrum of a scene falls with a power of frequency, its slope and height free for each patch.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import fft, ndimage

from lensmodel.core import psf
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample, distance
from lensmodel.core.types import Kernel, LensSettings, NoiseModel, Plane
from lensmodel.estimation.patches import Patch
from lensmodel.lab.images import flat_noise, noise_gain
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto, develop
from lensmodel.report.photo_crops import as_shown, crop_boxes
from lensmodel.workflow import pipeline

DEFAULT = (
    "meta/dji_fc300s_no_serial.jpg",
    "series/dji_fc300s_b.jpg",
    "raw/canon_kissx4_colorchart.dng",
    "raw/nikon_d1.nef",
    "large/dunes_21.2MP.jpg",
)
PAIRS = (("dji_fc300s_no_serial", "dji_fc300s_b"),)
CROP = 320  # pixels of a crop (chosen: enough for the eye)
TILE = 64  # pixels of a tile whose power is averaged (chosen)
SIZE = 31  # pixels of a kernel: that of an estimate
SLOPES = np.linspace(1.6, 3.2, 17)  # exponents s that are tried, 0.1 apart
USUAL_SLOPE, SLOPE_SCATTER = 2.4, 0.35  # prior of s: mean and standard deviation (chosen)
FILL = 0.01
"""What fills the zeros of |OTF|^2 where blur changes within a patch; the same for all that are compared."""
WIDTHS_PX = (0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3, 1.6, 2.0, 2.5)  # of Gaussians to compare with (chosen)


@dataclass(frozen=True)
class SeenPhoto:
    """A photo, its patches, and the models of both halves and of all of them."""

    name: str
    photo: LinearPhoto
    settings: LensSettings
    patches: tuple[Patch, ...]
    halves: tuple[list[PsfSample], list[PsfSample]]

    def model(self, half: int | None = None) -> LensModel:
        """Fit the model of one half, or of all samples."""
        chosen = [*self.halves[0], *self.halves[1]] if half is None else self.halves[half]
        return LensModel.fit(chosen).warmed()


def look_at(path: Path, aperture: float | None, estimator: str, count: int) -> SeenPhoto:
    """Calibrate the halves of a photo."""
    photo = develop(path)
    settings = pipeline.settings_of(photo)
    if settings.aperture is None:
        settings = pipeline.settings_of(photo, LensSettings(aperture=aperture))
    chosen = pipeline.find_patches(photo, count=count)
    halves: tuple[list[PsfSample], list[PsfSample]] = ([], [])
    for group in pipeline.patches_by_cell(chosen):
        for half, samples in enumerate(halves):
            part = group[half::2]
            if not part:
                continue
            try:
                found = pipeline.estimate_cell(
                    photo, part, settings=settings, photo_id=path.stem, estimator=estimator
                )
            except LensModelError as error:
                print(f"  {path.stem}: a cell tells nothing: {error}")
                continue
            samples.extend(cell.sample for cell in found)
    return SeenPhoto(path.stem, photo, settings, chosen.patches, halves)


def agreement(seen: SeenPhoto) -> dict[str, float]:
    """Median relative L2 and width ratio between the PSFs of both halves at the patches."""
    if not all(seen.halves):
        return {}
    first, second = seen.model(0), seen.model(1)
    pairs = [
        (
            first.query(p.position, seen.settings, SIZE).kernel,
            second.query(p.position, seen.settings, SIZE).kernel,
        )
        for p in seen.patches
    ]
    widths = [psf.rms_width(a) / psf.rms_width(b) for a, b in pairs]
    return {
        "rel_l2": float(np.median([distance(a, b).rel_l2 for a, b in pairs])),
        "width_apart": float(np.median(np.abs(np.log(widths)))),
    }


def periodogram(patch: Plane) -> NDArray[np.float64]:
    """Mean power of Hann-windowed tiles at half overlap, `(64, 33)`."""
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(TILE) + 0.5) / TILE)
    window = hann[:, None] * hann[None, :]
    tiles = [
        patch[row : row + TILE, col : col + TILE]
        for row in range(0, patch.shape[0] - TILE + 1, TILE // 2)
        for col in range(0, patch.shape[1] - TILE + 1, TILE // 2)
    ]
    power = [np.abs(fft.rfft2((tile - tile.mean()) * window)) ** 2 for tile in tiles]
    return np.asarray(np.mean(power, axis=0) / np.square(window).sum())


def log_likelihood(power: NDArray[np.float64], noise: float, kernel: Kernel, tiles: float) -> float:
    """Whittle's log likelihood of a spectrum, the best over slope and height of the scene's own.

    sum_f -(log P + I / P), P = a |f|^-s (|K|² + FILL) + noise; tiles that overlap by half count by a quarter.
    """
    rows, cols = fft.fftfreq(TILE)[:, None], fft.rfftfreq(TILE)[None, :]
    radius = np.hypot(rows, cols)
    used = (radius > 0.04) & (radius < 0.5)
    transfer = np.square(np.abs(psf.otf(psf.resized(kernel, SIZE), (TILE, TILE))))[used] + FILL
    seen, f = power[used], radius[used]
    best = -np.inf
    for slope in SLOPES:
        shape = f**-slope * transfer
        height = max(float(np.mean((seen - noise) / shape * f**0.5) / np.mean(f**0.5)), 1e-15)
        for factor in (0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.2):
            model = factor * height * shape + noise
            value = -float((np.log(model) + seen / model).sum()) * tiles
            value -= 0.5 * ((slope - USUAL_SLOPE) / SLOPE_SCATTER) ** 2
            best = max(best, value)
    return best


def spectrum_of(seen: SeenPhoto, patch: Patch) -> tuple[NDArray[np.float64], float, float]:
    """Spectrum of a patch, its noise, and how many independent tiles it has."""
    plane = seen.photo.planes[1, patch.row : patch.row + patch.size, patch.col : patch.col + patch.size]
    noise: NoiseModel = seen.photo.noise[1]
    count = ((patch.size - TILE) // (TILE // 2) + 1) ** 2
    return periodogram(plane), float(noise.sigma_at(float(plane.mean())) ** 2), count / 4.0


def prediction(
    seen: SeenPhoto, model: LensModel, patches: Sequence[Patch], learned: SeenPhoto
) -> dict[str, float]:
    """How much better a model predicts patches than no blur and than the best Gaussian of its photo."""
    known = [spectrum_of(learned, patch) for patch in learned.patches]
    gaussians = [psf.gaussian(SIZE, np.eye(2) * width**2) for width in WIDTHS_PX]
    totals = [sum(log_likelihood(p, n, k, t) for p, n, t in known) for k in gaussians]
    gaussian = gaussians[int(np.argmax(totals))]
    rows = []
    for patch in patches:
        power, noise, tiles = spectrum_of(seen, patch)
        kernel = model.query(patch.position, seen.settings, SIZE).kernel
        ours, none, one = (
            log_likelihood(power, noise, k, tiles) for k in (kernel, psf.delta(SIZE), gaussian)
        )
        rows.append((ours - none, ours - one))
    found = np.array(rows)
    return {
        "over_no_blur": float(np.median(found[:, 0])),
        "better_than_no_blur": float((found[:, 0] > 0).mean()),
        "over_gaussian": float(np.median(found[:, 1])),
        "better_than_gaussian": float((found[:, 1] > 0).mean()),
        "gaussian_px": WIDTHS_PX[int(np.argmax(totals))],
    }


def halos(before: NDArray[np.floating], after: NDArray[np.floating]) -> dict[str, float]:
    """How far the corrected photo leaves the range of the original beside strong edges.

    Range and step are those of the 21 pixels around; the largest excess of the 9 pixels around each of the
    2 percent steepest places counts, in percent of the step.
    """
    smooth = ndimage.gaussian_filter(np.asarray(before, dtype=np.float64), 1.0)
    slope = np.hypot(*np.gradient(smooth))
    strong = slope >= max(float(np.quantile(slope, 0.98)), 1e-6)
    high, low = ndimage.maximum_filter(before, 21), ndimage.minimum_filter(before, 21)
    beyond = np.maximum(after - high, 0.0) + np.maximum(low - after, 0.0)
    share = 100.0 * ndimage.maximum_filter(beyond, 9)[strong] / np.maximum(high - low, 1e-6)[strong]
    return {"median": float(np.median(share)), "p95": float(np.quantile(share, 0.95))}


def grain(before: NDArray[np.floating], after: NDArray[np.floating], side: int = 24) -> float | None:
    """Median noise gain over the ten flattest places."""
    places = [
        (flat_noise(before[r : r + side, c : c + side]), r, c)
        for r in range(0, before.shape[0] - side, side)
        for c in range(0, before.shape[1] - side, side)
    ]
    flat = [p for p in sorted(places) if p[0] > 0][:10]
    if not flat:
        return None
    cut = [(slice(r, r + side), slice(c, c + side)) for _, r, c in flat]
    return float(np.median([noise_gain(after[box], before[box]) for box in cut]))


def corrected(seen: SeenPhoto, model: LensModel, method: str, out: Path | None) -> dict[str, object]:
    """Correct crops of center and corners; halos and grain of each, and a picture for the eye."""
    frame = seen.photo.frame
    found: dict[str, object] = {}
    lateral = pipeline.lateral_of(seen.photo)
    strips = []
    for name, (row, col) in crop_boxes(frame.height, frame.width, CROP).items():
        fixed = pipeline.correct_photo(
            seen.photo, model, seen.settings, method=method, lateral=lateral, roi=(row, col, CROP, CROP)
        ).planes
        was = seen.photo.planes[:, row : row + CROP, col : col + CROP]
        found[name] = {"halo": halos(was[1], fixed[1]), "grain": grain(was[1], fixed[1])}
        gains = seen.photo.white_balance
        scale = 0.9 / max(float(np.percentile(was[1] * gains[1], 99.5)), 1e-3)
        strips.append(
            np.concatenate([as_shown(p * np.float32(min(scale, 4.0)), gains) for p in (was, fixed)])
        )
    if out is not None:
        Image.fromarray(np.concatenate(strips, axis=1)).save(out / f"{seen.name}.png")
    return found


def main() -> None:
    """Print what is seen of each photo."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, help="folder for crops, before over after")
    parser.add_argument("--estimator", default="default")
    parser.add_argument("--patches", type=int, default=16)
    parser.add_argument("--aperture", type=float, default=2.8, help="of photos that do not say theirs")
    parser.add_argument("--method", default="standard")
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    folder = Path(os.environ.get("LENSMODEL_TEST_DATA", "."))
    paths = wanted.photos or [folder / name for name in DEFAULT]
    if wanted.out:
        wanted.out.mkdir(parents=True, exist_ok=True)
    known: dict[str, SeenPhoto] = {}
    results: dict[str, dict[str, object]] = {}
    for path in paths:
        began = time.monotonic()
        try:
            seen = look_at(path, wanted.aperture, wanted.estimator, wanted.patches)
            known[seen.name] = seen
            row: dict[str, object] = {"patches": len(seen.patches), "halves": agreement(seen)}
            if all(seen.halves):
                rest = seen.patches[1::2]
                row["other_half"] = prediction(seen, seen.model(0), rest, seen)
            row["corrected"] = corrected(seen, seen.model(), wanted.method, wanted.out)
        except LensModelError as error:
            row = {"refused": str(error)}
        row["seconds"] = round(time.monotonic() - began)
        results[path.stem] = row
        print(f"{path.stem}: {json.dumps(row, indent=1)}", flush=True)
    for first, second in PAIRS:
        if first in known and second in known:
            for a, b in ((first, second), (second, first)):
                found = prediction(known[b], known[a].model(), known[b].patches, known[a])
                results[f"{a} predicts {b}"] = dict(found)
                print(f"{a} predicts {b}: {json.dumps(found)}", flush=True)
    if wanted.json:
        wanted.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
