"""Train and judge the learned choice of patches (`lensmodel.patches.good_regions`).

    python -m lab.training.train_regions collect PHOTOS TABLE.jsonl [GROUPS [METHOD]]
    python -m lab.training.train_regions fit TABLE.jsonl MODEL.npz
    python -m lab.training.train_regions judge TABLE.jsonl MODEL.npz

`collect` blurs photographs by simulated lenses, estimates the kernel in some windows of each and
writes one line a window: its features and how wrong the kernel was. It goes on where it stopped.
`fit` learns from the development half of the photos and reports on the test half; lenses of the
two halves differ as well. `judge` reports on the test half for a model that is there.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from lab.blind.judges import HyperLaplacian, squared_error
from lab.blind.methods import BlindMethod, compared
from lab.cases import list_photos, photo_half, scene_of
from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, ignore_step
from lensmodel.patches.checks import joined_details, look_at
from lensmodel.patches.good_regions import FEATURES, TreeEnsemble, features_of
from lensmodel.patches.select import RMapSelector, first_reasons
from lensmodel.patches.windows import BLOCKS_A_SIDE, measure_blocks, windows_of
from lensmodel.simulate import draw_lens

SIZE: Final = 192  # pixels of a window: that of a calibration
KERNEL_SIZE: Final = 55  # pixels: that of patch recurrence
WINDOWS_A_GROUP: Final = 8  # of one photo behind one lens (chosen)
FIRST_SEED: Final = {"dev": 7000, "test": 8000}  # of the lenses of each half: they differ (chosen)
TOP: Final = 3  # windows of a group that a choice is judged by (chosen)
_ARGUMENTS = 4  # of `collect` with GROUPS; one less at least


@dataclass(frozen=True, slots=True)
class Labelled:
    """One window: what it looks like and how good the kernel estimated in it was."""

    group: str
    half: str
    features: tuple[float, ...]
    r_map_score: float
    ncc: float
    rel_l2: float
    mtf_rmse: float
    error_ratio: float
    untouched_ratio: float


def label_group(photo: Path, number: int, estimator: BlindMethod) -> Iterator[Labelled]:
    """Blur one photo by one PSF of one lens, and judge estimates in some of its usable windows."""
    half = photo_half(photo.stem)
    rng = np.random.default_rng([number, FIRST_SEED[half]])
    lens = draw_lens(FIRST_SEED[half] + number)
    place = FieldPosition(float(rng.uniform(0.2, 1.0)), float(rng.uniform(-math.pi, math.pi)))
    kernel = lens.kernel(place, LensSettings(channel="g"), size=KERNEL_SIZE)
    sigma = float(np.exp(rng.uniform(math.log(0.003), math.log(0.015))))
    green, margin = scene_of(photo)[1], KERNEL_SIZE // 2
    blurred = signal.fftconvolve(green.astype(np.float64), kernel, mode="valid")
    plane = (blurred + rng.normal(0.0, sigma, blurred.shape)).astype(np.float32)
    noise = NoiseModel.white(sigma)
    blocks = measure_blocks(plane, noise, SIZE // BLOCKS_A_SIDE, 1.0, ignore_step)
    windows = windows_of(blocks, Frame(*plane.shape), noise)
    usable = np.flatnonzero(first_reasons(windows) == "")
    if usable.size < WINDOWS_A_GROUP:
        return
    drawn = np.sort(rng.choice(usable, WINDOWS_A_GROUP, replace=False))
    part = windows.take(drawn)
    patches = [
        np.ascontiguousarray(plane[r : r + SIZE, c : c + SIZE])
        for r, c in zip(part.rows, part.cols, strict=True)
    ]
    looked = joined_details(
        [
            look_at(patch, sigma, 1.0, (int(r), int(c)))
            for patch, r, c in zip(patches, part.rows, part.cols, strict=True)
        ]
    )
    features, r_map = features_of(part, looked), RMapSelector().score(part, looked)
    judge = HyperLaplacian()
    for i, patch in enumerate(patches):
        row, col = int(part.rows[i]) + margin, int(part.cols[i]) + margin
        sharp = green[row : row + SIZE, col : col + SIZE]
        try:
            found = np.asarray(estimator.estimate([patch], [noise], size=31).kernel)
        except NotEnoughEvidenceError:
            found = psf.delta(3)
        distance = psf.distance(found, kernel)
        floor = squared_error(judge.deconvolve(patch, kernel, sigma, (0.0, 0.0)), sharp)
        restored = judge.deconvolve(patch, found, sigma, distance.shift)
        yield Labelled(
            group=f"{photo.stem}/{number}",
            half=half,
            features=tuple(round(float(v), 5) for v in features[i]),
            r_map_score=float(r_map[i]),
            ncc=distance.ncc,
            rel_l2=distance.rel_l2,
            mtf_rmse=distance.mtf_rmse,
            error_ratio=squared_error(restored, sharp) / floor,
            untouched_ratio=squared_error(patch, sharp) / floor,
        )


def collect(photos: Path | None, table: Path, groups: int, method: str = "default") -> None:
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


@dataclass(frozen=True, slots=True)
class RegionsReport:
    """How well scores foretell the quality of an estimate on held-out photos and lenses.

    `overall` and `within` are Spearman's rank correlations of the predicted with the true kernel
    similarity S, over all windows, and the mean over groups of one photo and lens. Then, each for
    the best-scored windows of every group by the learned score, by the r-map's, and for all
    windows: the mean S; the mean relative L2 error; and the geometric mean of the error ratio over
    that of the untouched window. (The error ratio itself favours windows without detail, where
    even the true kernel restores little.)
    """

    windows: int
    groups: int
    overall: float
    within: float
    r_map_overall: float
    r_map_within: float
    similarity: tuple[float, float, float]
    rel_l2: tuple[float, float, float]
    error_ratio_over_untouched: tuple[float, float, float]


def fit(table: Path, model: Path, seed: int = 0) -> RegionsReport:
    """Learn from the development half, write the trees, report on the test half."""
    try:
        from sklearn.ensemble import GradientBoostingRegressor  # noqa: PLC0415  # needed for training only
    except ImportError as error:
        raise InvalidInputError("training needs scikit-learn; pip install --group lab") from error
    rows = read_table(table)
    learn, held = ([row for row in rows if row.half == half] for half in ("dev", "test"))
    if not learn or not held:
        raise InvalidInputError(f"{table} needs windows of both halves, has {len(learn)} and {len(held)}")
    trees = GradientBoostingRegressor(
        n_estimators=150,
        learning_rate=0.04,
        max_depth=3,
        min_samples_leaf=8,
        subsample=0.6,
        max_features=0.3,
        loss="huber",
        random_state=seed,
    ).fit(_features(learn), np.log([_unlike(row) for row in learn]))
    ensemble = _arrays(trees)
    ensemble.save(model)
    return judged(ensemble, held)


def _unlike(row: Labelled) -> float:
    return max(1.0 - row.ncc, 1e-4)


def _features(rows: Sequence[Labelled]) -> NDArray[np.float64]:
    values = np.array([row.features for row in rows])
    if values.shape[1] != len(FEATURES):
        raise InvalidInputError(
            f"the table has {values.shape[1]} features, the code {len(FEATURES)}; collect anew"
        )
    return values


def _arrays(model: object) -> TreeEnsemble:
    grown = [tree.tree_ for tree in model.estimators_[:, 0]]  # type: ignore[attr-defined]  # scikit-learn has no types
    nodes = max(tree.node_count for tree in grown)
    feature = np.full((len(grown), nodes), -1, np.int16)
    threshold, value = np.zeros((2, len(grown), nodes), np.float32)
    left, right = np.zeros((2, len(grown), nodes), np.int16)
    for i, tree in enumerate(grown):
        count = tree.node_count
        leaf = tree.children_left < 0
        feature[i, :count] = np.where(leaf, -1, tree.feature)
        # scikit-learn asks x <= t with x in single and t in double precision; with t rounded down
        # to single precision the answer is the same.
        single = tree.threshold.astype(np.float32)
        threshold[i, :count] = np.where(
            single > tree.threshold, np.nextafter(single, np.float32(-np.inf)), single
        )
        left[i, :count] = np.where(leaf, np.arange(count), tree.children_left)
        right[i, :count] = np.where(leaf, np.arange(count), tree.children_right)
        value[i, :count] = model.learning_rate * tree.value[:, 0, 0]  # type: ignore[attr-defined]  # as above
    start = float(np.ravel(model.init_.constant_)[0])  # type: ignore[attr-defined]  # as above
    return TreeEnsemble(start, feature, threshold, left, right, value)


def judged(ensemble: TreeEnsemble, rows: Sequence[Labelled]) -> RegionsReport:
    """Compare learned scores, r-map scores and chance on held-out windows."""
    learned = -ensemble.predict(_features(rows))
    r_map = np.array([row.r_map_score for row in rows])
    similarity, error = np.array([row.ncc for row in rows]), np.array([row.rel_l2 for row in rows])
    ratio = np.log([row.error_ratio / row.untouched_ratio for row in rows])
    groups = [np.flatnonzero([row.group == name for row in rows]) for name in sorted({r.group for r in rows})]

    def within(score: NDArray[np.float64]) -> float:
        return float(np.mean([_spearman(score[g], similarity[g]) for g in groups]))

    def best(value: NDArray[np.float64]) -> tuple[float, float, float]:
        tops = [
            float(np.mean([value[g[np.argsort(-score[g])[:TOP]]].mean() for g in groups]))
            for score in (learned, r_map)
        ]
        return tops[0], tops[1], float(value.mean())

    by_ratio = best(ratio)
    return RegionsReport(
        windows=len(rows),
        groups=len(groups),
        overall=_spearman(learned, similarity),
        within=within(learned),
        r_map_overall=_spearman(r_map, similarity),
        r_map_within=within(r_map),
        similarity=best(similarity),
        rel_l2=best(error),
        error_ratio_over_untouched=(math.exp(by_ratio[0]), math.exp(by_ratio[1]), math.exp(by_ratio[2])),
    )


def _spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(stats.spearmanr(a, b).statistic)


def main(arguments: Sequence[str]) -> None:
    """Run `collect` or `fit` from the command line."""
    if len(arguments) < _ARGUMENTS - 1:
        raise InvalidInputError(
            "usage: train_regions collect PHOTOS TABLE [GROUPS [METHOD]] | (fit or judge) TABLE MODEL"
        )
    verb, first, second, *rest = arguments
    if verb == "collect":
        groups, method = int(rest[0]) if rest else 240, rest[1] if len(rest) > 1 else "default"
        collect(Path(first), Path(second), groups, method)
    else:
        table, model = Path(first), Path(second)
        if verb == "judge":
            held = [row for row in read_table(table) if row.half == "test"]
            report = judged(TreeEnsemble.load(model), held)
        else:
            report = fit(table, model)
        sys.stdout.write(json.dumps(asdict(report), indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
