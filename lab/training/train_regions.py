"""Train the learned choice of patches (`lensmodel.patches.select`).

    python -m lab.training.train_regions collect PHOTOS TABLE.jsonl [GROUPS [METHOD]]
    python -m lab.training.train_regions fit TABLE.jsonl MODEL.npz

`collect` blurs photographs by simulated lenses and writes a line for some windows of each: its features, and
how wrong a kernel estimated in it was. It goes on where it stopped. `fit` learns from the development half.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal, stats

from lab import kernels
from lab.blind.methods import BlindMethod, compared
from lab.cases import list_photos, photo_half, scene_of
from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, ignore_step
from lensmodel.patches.good_regions import FEATURES, features_of
from lensmodel.patches.select import RMapSelector, first_reasons
from lensmodel.patches.windows import BLOCKS_A_SIDE, details_of, windows_of
from lensmodel.simulate import draw_lens

SIZE: Final = 192  # pixels of a window: that of a calibration
KERNEL_SIZE: Final = 55  # pixels: that of patch recurrence
WINDOWS_A_GROUP: Final = 8  # of one photo behind one lens (chosen)
# Windows that count for weights of 0 (chosen: of 10 to 1000, 100 and 300 rank windows best of scenes that are
# left out of the development half)
RIDGE: Final = 300.0
# Columns of energies and powers over noise, of which more never tells less: their weights are not positive
OVER_NOISE: Final = (*range(11), 12, 15, 16, 17, 19, 20, 21, 23, 24, 25)
FIRST_SEED: Final = {"dev": 7000, "test": 8000}  # of the lenses of each half: they differ (chosen)


@dataclass(frozen=True, slots=True)
class Labelled:
    """One window: what it looks like and how good the kernel estimated in it was."""

    group: str
    half: str
    features: tuple[float, ...]
    r_map_score: float
    ncc: float  # similarity S of the kernel estimated in it and the true one


def label_group(photo: Path, number: int, estimator: BlindMethod) -> Iterator[Labelled]:
    """Blur one photo by one PSF of one lens, and judge estimates in some of its usable windows."""
    half = photo_half(photo.stem)
    rng = np.random.default_rng([number, FIRST_SEED[half]])
    lens = draw_lens(FIRST_SEED[half] + number)
    place = FieldPosition(float(rng.uniform(0.2, 1.0)), float(rng.uniform(-math.pi, math.pi)))
    kernel = lens.kernel(place, LensSettings(channel="g"), size=KERNEL_SIZE)
    sigma = float(np.exp(rng.uniform(math.log(0.003), math.log(0.015))))
    blurred = signal.fftconvolve(scene_of(photo)[1].astype(np.float64), kernel, mode="valid")
    plane = (blurred + rng.normal(0.0, sigma, blurred.shape)).astype(np.float32)
    noise = NoiseModel.white(sigma)
    windows = windows_of(plane, noise, SIZE // BLOCKS_A_SIDE, 1.0, ignore_step)
    usable = np.flatnonzero(first_reasons(windows) == "")
    if usable.size < WINDOWS_A_GROUP:
        return
    drawn = np.sort(rng.choice(usable, WINDOWS_A_GROUP, replace=False))
    part = windows.take(drawn)
    corners = zip(part.rows, part.cols, strict=True)
    patches = [np.ascontiguousarray(plane[r : r + SIZE, c : c + SIZE]) for r, c in corners]
    looked = details_of(plane, part, 1.0)
    features, r_map = features_of(looked), RMapSelector().score(looked)
    for own, score, patch in zip(features, r_map, patches, strict=True):
        try:
            found = np.asarray(estimator.estimate([patch], [noise], size=31).kernel)
        except NotEnoughEvidenceError:
            found = psf.delta(3)
        rounded, ncc = tuple(round(float(v), 5) for v in own), kernels.distance(found, kernel).ncc
        yield Labelled(f"{photo.stem}/{number}", half, rounded, float(score), ncc)


def collect(photos: Path, table: Path, groups: int, method: str = "default") -> None:
    """Append labelled windows of `groups` photo-lens pairs to the table, skipping those it has."""
    estimator = compared.create(method)
    found = list_photos(photos)
    known = {row.group for row in read_table(table)} if table.exists() else set()
    for number in range(groups):
        photo = found[number % len(found)]
        if f"{photo.stem}/{number}" in known:
            continue
        lines = [json.dumps(asdict(row)) + "\n" for row in label_group(photo, number, estimator)]
        with table.open("a", encoding="utf-8") as out:
            out.writelines(lines)


def read_table(table: Path) -> list[Labelled]:
    """Read what `collect` wrote."""
    rows = [json.loads(line) for line in table.read_text(encoding="utf-8").splitlines()]
    return [Labelled(**{**row, "features": tuple(row["features"])}) for row in rows]


def fit(table: Path, model: Path) -> dict[str, float]:
    """Learn from the development half by ridge regression; rank correlations with S on the test half."""
    rows = read_table(table)
    learn, held = ([row for row in rows if row.half == half] for half in ("dev", "test"))
    if not learn or not held:
        raise InvalidInputError(f"{table} needs windows of both halves, has {len(learn)} and {len(held)}")
    features, error = _features(learn), np.log([max(1.0 - row.ncc, 1e-4) for row in learn])
    spread = np.maximum(features.std(axis=0), 1e-6)
    standard = np.vstack([(features - features.mean(axis=0)) / spread, math.sqrt(RIDGE) * np.eye(FEATURES)])
    most = np.where(np.isin(np.arange(FEATURES), OVER_NOISE), 0.0, np.inf)
    wanted = np.append(error - error.mean(), np.zeros(FEATURES))
    weights = optimize.lsq_linear(standard, wanted, (-np.inf, most)).x / spread
    model.parent.mkdir(parents=True, exist_ok=True)
    np.savez(model, weights=weights, offset=error.mean() - features.mean(axis=0) @ weights)
    similarity = [row.ncc for row in held]
    scores = {"learned": -_features(held) @ weights, "r-map": [row.r_map_score for row in held]}
    return {name: float(stats.spearmanr(own, similarity).statistic) for name, own in scores.items()}


def _features(rows: Sequence[Labelled]) -> NDArray[np.float64]:
    values = np.array([row.features for row in rows])
    if values.shape[1] != FEATURES:
        raise InvalidInputError(f"the table has {values.shape[1]} features, not {FEATURES}")
    return values


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `collect` or `fit` from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("verb", choices=["collect", "fit"])
    parser.add_argument("files", type=Path, nargs=2)
    parser.add_argument("groups", type=int, nargs="?", default=240)
    parser.add_argument("method", nargs="?", default="default")
    asked = parser.parse_args(arguments)
    if asked.verb == "collect":
        collect(asked.files[0], asked.files[1], asked.groups, asked.method)
    else:
        print(json.dumps(fit(asked.files[0], asked.files[1]), indent=1))


if __name__ == "__main__":
    main()
