"""A library of lenses with photos through them, in shards on disk; seeded, resumable, on any number of cores.

A lens is drawn from its number alone, so that a library is the same however often it was interrupted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from lab.population import traced
from lab.population.kernels import PopulationLens, behind_sensor, coarse_of, fine_of, kernels_of, scaled
from lab.population.photos import Camera, Scenes
from lab.population.prescriptions import HELD_OUT, PRESCRIPTIONS
from lab.population.wavefronts import RandomLens
from lensmodel.core.files import atomic
from lensmodel.core.psf import KINDS, PatchKind
from lensmodel.neural.network import FAR_M, assembled, outer_cells, to_octant

Family = Literal["wavefront", "third-order", "traced"]
FAMILIES: Final[tuple[Family, ...]] = ("wavefront", "third-order", "traced")
SHARD: Final = 25  # lenses in a shard: a minute's work at most is lost when a run is ended

_KIND_SHARES: Final = (0.64, 0.12, 0.24)
_PHOTO_COUNTS: Final = ((1, 2, 3, 5), (0.3, 0.2, 0.2, 0.3))
_PLAIN_PATCHES: Final = 72  # of each photo
_OPENED: Final = 0.35  # share of traced lenses of training that are opened far beyond their design
_RESCALED: Final = (0.72, 1.4)  # range of the pixels of before over those of a rescaled lens (chosen)
_OFF_CENTRE: Final = 0.08  # share of lenses whose pictures are cut out of a larger one


@dataclass(frozen=True, slots=True)
class State:
    """A lens as it is set for a photo."""

    lens: PopulationLens
    f_number: float
    focal_mm: float
    focus_m: float


def places(rng: np.random.Generator, cells: int = 4) -> NDArray[np.float64]:
    """8 + cells^2 places of a frame: the centre, three about it, a jittered grid, near the four corners."""
    aspect = rng.choice([1.5, 1.5, 4 / 3, 16 / 9])
    hx, hy = aspect / np.hypot(aspect, 1), 1 / np.hypot(aspect, 1)
    half = np.array([hx, hy])
    at = [np.array([0.001, 0.0005]), *rng.normal(0, 0.15, (3, 2))]
    at += [((np.array(cell) + rng.random(2)) * (2 / cells) - 1) * half for cell in np.ndindex(cells, cells)]
    at += [np.array([sx, sy]) * half * rng.uniform(0.82, 0.98) for sx in (-1, 1) for sy in (-1, 1)]
    return np.array(at)


def draw_states(family: Family, rng: np.random.Generator, *, held_out: bool) -> list[State]:
    """Draw a lens as it is photographed: wide open and stopped down, at some focal lengths and distances."""
    apart = rng.spawn(1)[0]
    if family == "traced":
        names = sorted(name for name in PRESCRIPTIONS if (name in HELD_OUT) == held_out)
        lens = traced.draw(rng, names, opened=not held_out and apart.random() < _OPENED)
        ways: list[tuple[PopulationLens, float, float]] = [(lens, lens.focal_mm, FAR_M)]
        ways += [(near, near.focal_mm, near.focus_m) for near in _refocused(lens, apart)]
    else:
        second = family == "wavefront" and rng.random() < 0.12
        drawn = RandomLens(rng, family, zoom=second)
        ways = [(drawn, drawn.focal_mm, FAR_M)]
        if second:
            state, ratio = float(rng.uniform(0.3, 1.0)), float(np.exp(rng.uniform(np.log(1.2), np.log(4.0))))
            zooms, focuses = ((1, 0), (0, 1), (1, 1))[int(apart.integers(3))]
            focal = drawn.focal_mm * ratio ** (state * zooms)
            focus = min(focal / _magnification(apart) / 1000, FAR_M) if focuses else FAR_M
            ways.append((drawn.at_state(state), focal, focus))
    stops = [0.0, *rng.uniform(0.4, 3.0, int(rng.choice([0, 1, 2], p=[0.6, 0.28, 0.12])))]
    widest = ways[0][0].f_number
    pairs = [(way, stop) for i, way in enumerate(ways) for stop in (stops if i < 2 else stops[:1])]
    return [State(lens, widest * 2 ** (stop / 2), focal, focus) for (lens, focal, focus), stop in pairs]


def _refocused(lens: traced.TracedLens, rng: np.random.Generator) -> list[traced.TracedLens]:
    """The lens focused on one or two nearer things, as far as it forms an image of them; often not at all."""
    count = int(rng.choice([0, 1, 2], p=[0.5, 0.35, 0.15]))
    near = [lens.at_focus(min(lens.focal_mm / _magnification(rng) / 1000, FAR_M)) for _ in range(count)]
    return [one for one in near if traced.forms_image(one)]


def _magnification(rng: np.random.Generator) -> float:
    """Focal length over distance: a landscape's foreground to the nearest that ordinary lenses focus on."""
    return float(np.exp(rng.uniform(np.log(0.01), np.log(0.15))))


def draw_sensor(rng: np.random.Generator) -> tuple[float, float]:
    """Separation of the optical low-pass filter's spots and r.m.s. diffusion, both in pixels."""
    separation = rng.uniform(0.35, 1.0) if rng.random() < 0.35 else 0.0
    diffusion = rng.uniform(0.1, 0.4) if rng.random() < 0.5 else 0.0
    if rng.random() < 0.04:
        diffusion = rng.uniform(0.4, 2.5)
    return float(separation), float(diffusion)


def make_lens(
    family: Family, number: int, scenes: Scenes, *, held_out: bool, plain: bool = False
) -> dict[str, Any] | None:
    """Make one lens with the statistics of its photos; None where they hardly show anything."""
    rng = np.random.default_rng([number, FAMILIES.index(family), int(held_out)])
    states = draw_states(family, rng, held_out=held_out)
    if plain:
        states = states[:1]
    xy = places(rng, 4 if held_out else 3)
    on_lens = xy
    if rng.random() < _OFF_CENTRE and not plain:
        size = rng.uniform(0.45, 0.95)
        on_lens = size * xy + rng.uniform(-1, 1, 2) * (1 - size) * np.array([0.8, 0.5])
    stacked = np.array([kernels_of(state.lens, on_lens, state.f_number) for state in states])
    if not plain:
        stacked = behind_sensor(stacked, *draw_sensor(rng))
    set_so = np.array([(s.f_number, s.focal_mm, s.focus_m) for s in states], np.float32)
    return _photographed(rng, scenes, xy, stacked, set_so, states[0].lens.pitch_um, plain=plain)


def retake(
    stored: Mapping[str, NDArray[Any]],
    scenes: Scenes,
    rng: np.random.Generator,
    *,
    plain: bool,
    rescaled: bool,
) -> dict[str, Any] | None:
    """Take other photos through a lens of the library; None where its kernels hold a file's processing."""
    pitch, kind = stored["facts"]
    if KINDS[int(kind)] != "raw":
        return None
    outer = stored["coarse"][..., outer_cells()]
    kernels = assembled(np.concatenate([stored["fine"].reshape(*outer.shape[:3], -1), outer], -1))
    if rescaled:
        scale = float(np.exp(rng.uniform(*np.log(_RESCALED))))
        kernels, pitch = scaled(kernels, scale), pitch / scale
    xy, states = stored["xy"].astype(np.float64), stored["states"].astype(np.float32)
    return _photographed(rng, scenes, xy, kernels.astype(np.float32), states, float(pitch), plain=plain)


def _photographed(
    rng: np.random.Generator, scenes: Scenes, xy: NDArray[np.float64], stacked: NDArray[np.float32],
    states: NDArray[np.float32], pitch_um: float, *, plain: bool,
) -> dict[str, Any] | None:  # fmt: skip
    """Take photos through a lens: what a shard holds of it; None where they hardly show anything."""
    kind: PatchKind = "raw" if plain else KINDS[int(rng.choice(len(KINDS), p=_KIND_SHARES))]
    camera = Camera(rng, scenes, kind, xy, stacked, plain)
    photos = int(rng.choice(_PHOTO_COUNTS[0], p=_PHOTO_COUNTS[1]))
    count = int(rng.choice([32, 56, 110], p=[0.35, 0.4, 0.25]))
    statistics, of = camera.take(5, 5 * _PLAIN_PATCHES) if plain else camera.take(photos, count)
    if len(of) < 8:
        return None
    if camera.processing is not None:
        stacked = camera.processing.applied(stacked)
    return {
        "statistics": to_octant(statistics, xy[of[:, 0]]).astype(np.float16),
        **dict(zip(("place", "photo", "state"), of.T.astype(np.int16), strict=True)),
        "xy": xy.astype(np.float32),
        "fine": fine_of(stacked).astype(np.float16),
        "coarse": coarse_of(stacked).astype(np.float16),
        "states": states,
        "facts": np.array([pitch_um, KINDS.index(kind)], np.float32),
    }


@dataclass(frozen=True, slots=True)
class Order:
    """What lenses to make, and where they go."""

    folder: Path  # of shards, and of `scenes.build`
    scenes: Path
    family: Family
    held_out: bool = False  # see `make_lens`
    plain: bool = False
    # A folder of shards: other photos are taken through its lenses, and no lens is drawn
    through: Path | None = None
    rescaled: bool = False  # whether they stand before other pixels then, see `retake`

    def lenses(self, shard: int) -> Iterator[dict[str, Any] | None]:
        """Make the lenses of a shard."""
        crops = Scenes(self.scenes, held_out=self.held_out)
        if self.through is None:
            for number in range(shard * SHARD, (shard + 1) * SHARD):
                yield make_lens(self.family, number, crops, held_out=self.held_out, plain=self.plain)
        elif (path := _path(self.through, self.family, shard)).exists():
            for number, stored in enumerate(load_shard(path)):
                rng = np.random.default_rng([number, shard, FAMILIES.index(self.family), int(self.rescaled)])
                yield retake(stored, crops, rng, plain=self.plain, rescaled=self.rescaled)

    def make(self, shard: int) -> int:
        """Write a shard that is not there yet; return how many lenses it has got."""
        path = _path(self.folder, self.family, shard)
        if path.exists():
            return 0
        lenses = [lens for lens in self.lenses(shard) if lens is not None]
        if not lenses:
            return 0
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic(path) as file:
            np.savez(file, **numbered(lenses))
        return len(lenses)


def generate(order: Order, shards: Sequence[int], processes: int) -> Iterator[int]:
    """Make the shards that are not there yet; yield how many lenses each has got."""
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(order.make, shards)


def _path(folder: Path, family: Family, shard: int) -> Path:
    return folder / f"{family}-{shard:05d}.npz"


def numbered(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Arrays of several rows under one name each, as a file holds them."""
    return {f"{i}/{name}": value for i, row in enumerate(rows) for name, value in row.items()}


def load_shard(path: Path) -> list[dict[str, NDArray[Any]]]:
    """Read what `numbered` arrays make up."""
    lenses: dict[str, dict[str, NDArray[Any]]] = {}
    with np.load(path) as shard:
        for key in shard.files:
            number, name = key.split("/")
            lenses.setdefault(number, {})[name] = shard[key]
    return list(lenses.values())
