"""Lenses of a library as sets of samples and queries, for training and judging."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lab.images import zone_masks
from lab.population.library import FAMILIES, Family, load_shard, numbered
from lensmodel.core.files import atomic
from lensmodel.core.types import ZONES
from lensmodel.neural.network import (
    FieldAnswer,
    FieldNetwork,
    assembled,
    from_octant_image,
    group,
    octant_of,
    outer_cells,
    to_octant_image,
)

_UNKNOWN: Final = 0.08  # share of sets whose aperture, and of those whose pitch, is not known
_POWERS: Final = np.arange(0.84, 1.15, 0.02)


@dataclass(slots=True)
class Lens:
    """One lens of the library, ready for sets."""

    statistics: NDArray[np.float16]
    place: NDArray[np.int64]
    photo: NDArray[np.int64]
    state: NDArray[np.int64]
    xy: NDArray[np.float64]
    settings: NDArray[np.float64]  # (states, SETTINGS)
    truth: NDArray[np.float16]  # (states, places, 3, _LOGITS), in the octants' frames

    @classmethod
    def of(cls, stored: Mapping[str, NDArray[Any]]) -> Lens:
        """Make one of what a shard holds."""
        xy = stored["xy"].astype(np.float64)
        pitch, kind = stored["facts"]
        states = stored["states"].astype(np.float64)
        f_number, focal, focus = states.T
        logs = [np.log(values) for values in (f_number, 0.54 * f_number / pitch, focal, focus)]
        settings = np.column_stack([*logs, np.full(len(states), kind)])
        octants = octant_of(xy)
        turned = []
        for name in ("fine", "coarse"):
            kernels = stored[name]
            parts = np.stack([to_octant_image(int(o), kernels[:, p]) for p, o in enumerate(octants)], 1)
            outer = name == "coarse"
            turned.append(parts[..., outer_cells()] if outer else parts.reshape(*parts.shape[:3], -1))
        return cls(
            np.nan_to_num(stored["statistics"]), stored["place"].astype(int), stored["photo"].astype(int),
            stored["state"].astype(int), xy, settings, np.concatenate(turned, -1),
        )  # fmt: skip


def load_library(folder: Path, known: set[str], families: Sequence[Family] = FAMILIES) -> list[Lens]:
    """Lenses of the shards that are not known yet; adds their names."""
    lenses: list[Lens] = []
    for family in families:
        for path in sorted(folder.glob(f"{family}-*.npz")):
            if path.name in known:
                continue
            known.add(path.name)
            lenses += [Lens.of(stored) for stored in load_shard(path)]
    return lenses


@dataclass(slots=True)
class Set:
    """Some samples of one lens, and queries with their truth."""

    statistics: NDArray[np.float32]
    xy: NDArray[np.float64]
    settings: NDArray[np.float64]
    photo: NDArray[np.int64]
    query_xy: NDArray[np.float64]
    query_settings: NDArray[np.float64]
    truth: NDArray[np.float16]


def _swapped(
    statistics: NDArray[np.float32], truth: NDArray[np.float16]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Exchange red and blue: no network should know which is which."""
    out = statistics.copy()
    level = group("level").start
    levels = slice(level, level + 2), slice(level + 4, level + 6)
    for red, blue in ((group("red"), group("blue")), levels):
        out[:, red], out[:, blue] = statistics[:, blue], statistics[:, red]
    return out, truth[:, ::-1]


def draw_set(lens: Lens, samples: int, queries: int, rng: np.random.Generator, *, varied: bool = True) -> Set:
    """Draw samples of one to all photos, and queries; half the time with no sample at their places."""
    index = np.arange(len(lens.place))
    if samples <= 24 and rng.random() < 0.5:
        index = index[lens.photo == rng.choice(lens.photo)]
    asked = rng.choice(len(lens.xy), queries, replace=False)
    any_state = rng.random() < 0.5
    state = int(rng.integers(len(lens.settings)) if any_state else rng.choice(lens.state[index]))
    if samples <= 2:
        asked[0] = lens.place[rng.choice(index)]
        index = np.concatenate([index[lens.place[index] == asked[0]], index]) if samples == 1 else index
        chosen = index[:1] if samples == 1 else rng.permutation(index)[:samples]
        if rng.random() < 0.7:
            state = int(lens.state[chosen[0]])
    else:
        if rng.random() < 0.5 and len(apart := index[~np.isin(lens.place[index], asked[: queries // 2])]) > 2:
            index = apart
        chosen = rng.permutation(index)[:samples]
    settings = lens.settings.copy()
    if varied and rng.random() < _UNKNOWN:
        settings[:, :2] = np.nan
    elif varied and rng.random() < _UNKNOWN:
        settings[:, 1] = np.nan
    for column in (2, 3):  # of fixed lenses, and those that write nothing
        if len(np.unique(settings[:, column])) == 1 or rng.random() < 0.2:
            settings[:, column] = np.nan
    statistics, truth = lens.statistics[chosen].astype(np.float32), lens.truth[state][asked]
    if varied and rng.random() < 0.5:
        statistics, truth = _swapped(statistics, truth)
    return Set(
        statistics, lens.xy[lens.place[chosen]], settings[lens.state[chosen]], lens.photo[chosen],
        lens.xy[asked], np.repeat(settings[state][None], queries, 0), truth,
    )  # fmt: skip


def _answers(network: FieldNetwork, drawn: Set) -> Iterator[tuple[FieldAnswer, NDArray[np.float64]]]:
    """What the network answers to each query of a set, and the true kernels."""
    parts = [np.flatnonzero(drawn.photo == photo) for photo in np.unique(drawn.photo)]
    encoded = [
        network.encode(drawn.statistics[part], drawn.xy[part], drawn.settings[part][0]) for part in parts
    ]
    tokens = np.concatenate(encoded)[np.argsort(np.concatenate(parts))].astype(np.float32)
    memory = network.memory(tokens, drawn.xy, drawn.settings)
    for xy, row, shares in zip(drawn.query_xy, drawn.query_settings, drawn.truth, strict=True):
        truth = from_octant_image(int(octant_of(xy)), assembled(shares))
        yield network.query(memory, xy, row), truth


def _relative(kernels: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.square(kernels - truth).sum((1, 2)) / np.square(truth).sum((1, 2)))


def answered(network: FieldNetwork, drawn: Set) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Relative L2 errors of the network's kernels on a set, and those it expects; both (queries, 3)."""
    pairs = [(_relative(answer.kernels, truth), answer.error) for answer, truth in _answers(network, drawn)]
    return np.array([made for made, _ in pairs]), np.array([told for _, told in pairs])


def best_powers(network: FieldNetwork, sets: Iterable[Set]) -> tuple[float, float, float]:
    """Powers of the kernels of red, green and blue that err least: below 1, what is learned is too sure."""
    errors = []
    for drawn in sets:
        for answer, truth in _answers(network, drawn):
            raised = [np.maximum(answer.kernels, 0.0) ** power for power in _POWERS]
            errors.append([_relative(k / k.sum((1, 2), keepdims=True), truth) for k in raised])
    mean = np.mean(errors, axis=0)  # (powers, 3)
    green, others = (float(_POWERS[int(np.argmin(row))]) for row in (mean[:, 1], mean[:, 0] + mean[:, 2]))
    return others, green, others


def of_photos(lens: Lens, photos: int) -> Set:
    """All samples of the first photos, and all places at the first state as queries."""
    chosen = np.nonzero((lens.photo < photos) & (lens.state == 0))[0]
    places = np.arange(len(lens.xy))
    return Set(
        lens.statistics[chosen].astype(np.float32), lens.xy[lens.place[chosen]],
        lens.settings[lens.state[chosen]], lens.photo[chosen],
        lens.xy, np.repeat(lens.settings[:1], len(places), 0), lens.truth[0],
    )  # fmt: skip


def understated(network: FieldNetwork, sets: Iterable[Set]) -> float:
    """How much the errors of kernels are understated: median of the logarithm of made over told errors."""
    pairs = [answered(network, drawn) for drawn in sets]
    made, told = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
    return float(np.median(np.log(made / told)))


def judge(network: FieldNetwork, sets: Iterable[Set]) -> dict[str, float]:
    """Relative L2 of kernels, mean by colour, and of green by zone, there also the median of lenses' means.

    "told_right" is the share of places whose told error is within a factor of 1.5.
    """
    made, told = [], []
    of_lens: dict[str, list[float]] = {zone: [] for zone in ZONES}
    of_place: dict[str, list[float]] = {zone: [] for zone in ZONES}
    for drawn in sets:
        errors, expected = answered(network, drawn)
        made.append(errors)
        told.append(expected)
        r = np.hypot(*drawn.query_xy.T)
        for zone, inside in zone_masks(r).items():
            if inside.any():
                of_lens[zone].append(float(errors[inside, 1].mean()))
                of_place[zone] += errors[inside, 1].tolist()
    e, t = np.concatenate(made), np.concatenate(told)
    figures = {colour: float(e[:, i].mean()) for i, colour in enumerate("rgb")}
    figures |= {zone: float(np.mean(values)) for zone, values in of_place.items()}
    figures |= {f"{zone}_median": float(np.median(values)) for zone, values in of_lens.items()}
    right = np.abs(np.log(t[:, 1] / e[:, 1])) < math.log(1.5)
    return {**figures, "told_right": float(right.mean())}


def save_sets(sets: Sequence[Set], path: Path) -> None:
    """Write sets to one file."""
    rows = [{f.name: getattr(one, f.name) for f in fields(Set)} for one in sets]
    with atomic(path) as file:
        np.savez_compressed(
            file, **numbered([row | {"statistics": row["statistics"].astype(np.float16)} for row in rows])
        )


def load_sets(path: Path) -> list[Set]:
    """Read what `save_sets` wrote."""
    return [Set(**row | {"statistics": row["statistics"].astype(np.float32)}) for row in load_shard(path)]


def fixed_set(lenses: Sequence[Lens], *, samples: int = 48, queries: int = 7, count: int = 8) -> list[Set]:
    """A small set to hold weights by: the first photos of some lenses, every few of their places."""
    chosen = []
    for lens in lenses[:: max(len(lenses) // count, 1)][:count]:
        asked = slice(None, None, len(lens.xy) // queries)
        kept = {f.name: getattr(of_photos(lens, 1), f.name) for f in fields(Set)}
        cut = {n: asked if n.startswith(("query", "truth")) else slice(samples) for n in kept}
        chosen.append(Set(**{name: value[cut[name]] for name, value in kept.items()}))
    return chosen


def adjusted(
    data: bytes, *, powers: Sequence[float] = (1.0, 1.0, 1.0), raised: float = 0.0, **facts: object
) -> bytes:
    """Weights with more facts in their provenance, all logits of a colour scaled, told errors raised."""
    with np.load(BytesIO(data)) as stored:
        arrays: dict[str, Any] = dict(stored)
    for name in ("kernel.2.weight", "kernel.2.bias"):
        colours = zip(powers, np.split(arrays[name].astype(np.float32), 3), strict=True)
        arrays[name] = np.concatenate([power * part for power, part in colours]).astype(np.float16)
    arrays["error.1.bias"] = (arrays["error.1.bias"].astype(np.float32) + raised).astype(np.float16)
    told = {**json.loads(bytes(arrays["provenance"]).decode()), **facts}
    arrays["provenance"] = np.frombuffer(json.dumps(told).encode(), np.uint8)
    out = BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()
