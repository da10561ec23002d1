"""Choose the windows of a photo that tell about the PSF: by the r-map, or by learned good regions.

`_spread` keeps of scored windows the best ones that lie apart: non-maximum suppression, quotas, cells of the
field. `spread_evenly`, for the learned estimator, moves one window in each of equal cells to where detail is
richest; flat and clipped ones alone are left out, for the network weighs its patches.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, Frame, NoiseModel, Plane, StepHook, ignore_step, zone_of
from lensmodel.patches.good_regions import GoodRegionsSelector
from lensmodel.patches.windows import BLOCKS_A_SIDE, Windows, details_of, windows_of
from lensmodel.photo.values import LinearPhoto

logger = logging.getLogger(__name__)

Reason: TypeAlias = Literal["clipped", "dark", "flat", "one-directional", "duplicate"]
"""Why a window was not taken; `duplicate` means that a better one lies too near or the quota is full."""

SMALLEST_PATCH: Final = 64  # pixels: the least that estimators take
MAX_REJECTIONS: Final = 2000  # a photo has ten thousand windows; a report needs no more than this
CLIPPED_LIMIT: Final = 0.005  # share of a window's pixels (chosen): a few specular points do little harm
DARK_LIMIT: Final = 0.5  # share of a window's pixels: the other half still has edges (chosen)
FLAT_CONTRAST: Final = 4.0  # variance of signal over noise: below, noise decides the estimate (chosen)
FLAT_EIGENVALUE: Final = 10.0  # smaller eigenvalue of the structure tensor over that of noise (chosen)
ONE_DIRECTION_RATIO: Final = 0.05  # the same over the larger one: a line has next to nothing (chosen)
SECTOR_INFORMATION: Final = float(np.log(2.0))  # power twice that of noise, signal as strong as noise
JPEG_WEIGHT: Final = 0.3  # JPEG files were sharpened and gamma-coded: their patches count for less
EVIDENCE_FLOOR: Final = 0.25  # bits a frequency: signal as strong as noise over a quarter of them
SHORTLIST_A_SECTOR: Final = 8  # windows that the costlier scores look at: several times those taken (chosen)


@dataclass(frozen=True, slots=True)
class Patch:
    """A window of a photo that tells about the PSF, or one that was not taken."""

    row: int  # top-left pixel
    col: int
    size: int  # side in pixels
    position: FieldPosition  # of the window's centre
    score: float = 0.0  # how much it tells, 0 to 1
    cell: int = 0  # number of the field cell; patches of one cell may share one kernel
    reason: Reason | None = None  # why it was not taken


@dataclass(frozen=True, slots=True)
class Selection:
    """The outcome of patch selection on one plane."""

    patches: tuple[Patch, ...]  # ordered by cell, the best of each cell first
    # at most `MAX_REJECTIONS` of them, spread evenly over the photo and the reasons
    rejected: tuple[Patch, ...]


class Selector(Protocol):
    """Says how much each window tells about the PSF (Hirsch and Schölkopf, ICCV 2015, section 5.2)."""

    def score(self, windows: Windows) -> NDArray[np.float64]:
        """Score n windows by edges, noise, clipping and spectra, shape (n,), 0..1: higher tells more."""


# --- the selectors -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RMapSelector:
    """Edges in every direction where the r-map is high, and signal at every frequency.

    With e the energy of the kept edges over that of noise in eight directions, e_(2) its second
    smallest entry, and S/N the spectrum over noise in 3 bands by 8 sectors::

        score = ( log10 e_(2) + mean log10 max(S/N, 1) ) / 8
    """

    def score(self, windows: Windows) -> NDArray[np.float64]:
        """Return one score a window; see `lensmodel.Selector`."""
        information = np.maximum(windows.information, 0.0).mean(axis=(1, 2)) / np.log(10.0)
        return np.clip((edge_score(windows) + information) / 8.0, 0.0, 1.0)


def edge_score(windows: Windows) -> NDArray[np.float64]:
    """Decimal logarithm of the second weakest direction's edge energy over noise, at least 0."""
    return np.log10(np.maximum(np.sort(windows.directions, axis=1)[:, 1], 1.0))


selectors: Registry[Selector] = Registry(
    "patch selector", {"r-map": RMapSelector, "good-regions": GoodRegionsSelector}
)


def select(
    plane: Plane,
    noise: NoiseModel,
    *,
    clip: float = 1.0,
    count: int = 48,
    size: int = 192,
    selector: str | Selector = "r-map",
    jpeg: bool = False,
    coarse_noise: NoiseModel | None = None,
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose at most `count` patches of a plane that tell about the PSF, spread over the field.

    They are of `size` pixels a side, and smaller where the shorter side of the frame is less than four of
    them. `coarse_noise` is that of coarse detail where it is more than `noise`.
    """
    chooser, shorter = selectors.resolve(selector), min(plane.shape)
    _require_room(Frame(*plane.shape), SMALLEST_PATCH)
    fitting = min(size, max(shorter // 4, min(shorter, 2 * SMALLEST_PATCH)))
    windows = windows_of(plane, noise, fitting // BLOCKS_A_SIDE, clip, on_step)
    reasons = first_reasons(windows)
    usable = np.flatnonzero(reasons == "")
    short = usable[_shortlist(windows.take(usable))]
    reasons[usable] = "duplicate"
    looked = details_of(plane, windows.take(short), clip, coarse_noise)
    flat = looked.evidence < EVIDENCE_FLOOR
    one_directional = looked.information[:, 0].min(axis=1) < SECTOR_INFORMATION
    reasons[short] = np.select([flat, one_directional], ["flat", "one-directional"], default="")
    good = np.flatnonzero(reasons[short] == "")
    if not good.size:
        raise _nothing_usable(reasons.tolist())
    score = chooser.score(looked.take(good)) * (JPEG_WEIGHT if jpeg else 1.0)
    order = np.argsort(-score, kind="stable")
    short, score, looked = short[good[order]], score[order], looked.take(good[order])
    reasons[short] = "duplicate"

    def patch(i: int, told: float = 0.0, cell: int = 0, reason: Reason | None = None) -> Patch:
        position = FieldPosition(min(float(windows.r[i]), 1.0), float(windows.phi[i]))
        corner = int(windows.rows[i]), int(windows.cols[i])
        return Patch(*corner, windows.size, position, float(told), cell, reason)

    patches: list[Patch] = []
    for number, cell in enumerate(_spread(looked, count)):
        patches += [patch(i, told, number) for i, told in zip(short[cell], score[cell], strict=True)]
        reasons[short[cell]] = ""
    left = np.flatnonzero(reasons != "")
    logger.info("chose %d of %d windows; rejected: %s", len(patches), len(windows), Counter(reasons[left]))
    rejected = [patch(i, reason=reasons[i]) for i in left[:: left.size // MAX_REJECTIONS + 1]]
    return Selection(tuple(patches), tuple(rejected))


def _require_room(frame: Frame, size: int) -> None:
    if min(frame.height, frame.width) < size:
        raise NoUsablePatchesError(
            f"the photo is {frame.width} x {frame.height} px, a patch needs {size}; "
            "use the photo in its full size"
        )


def first_reasons(windows: Windows) -> NDArray[np.str_]:
    """Reason of each window from block sums alone, the first that holds; empty where none does."""
    small, large = windows.eigenvalues.T
    tests: list[tuple[Reason, NDArray[np.bool_]]] = [
        ("clipped", windows.clipped > CLIPPED_LIMIT),
        ("dark", windows.dark > DARK_LIMIT),
        ("flat", (windows.contrast < FLAT_CONTRAST) | (large < FLAT_EIGENVALUE)),
        ("one-directional", small < ONE_DIRECTION_RATIO * large),
        ("flat", small < FLAT_EIGENVALUE),
    ]
    return np.select([test for _, test in tests], [reason for reason, _ in tests], default="").astype("U16")


def _nothing_usable(reasons: Iterable[str]) -> NoUsablePatchesError:
    counts = Counter(reasons)
    listed = ", ".join(f"{name} {number}" for name, number in counts.most_common())
    return NoUsablePatchesError(
        f"none of {counts.total()} windows is usable ({listed}); take a well exposed scene with fine detail "
        "in all directions, at a low ISO"
    )


# --- spread over the field -----------------------------------------------------------------------

RINGS: Final = 8  # of equal width in r: as many as are needed to follow blur along the radius (chosen)
OCTANTS: Final = 8  # eighths of a turn, by definition
PATCHES_A_CELL: Final = 3  # on average: more leave places without any, one alone is a poor estimate (chosen)
MOST_A_CELL: Final = 4  # pooling the normal equations of four patches is worth most of what twelve give
CELL_R: Final = 0.12  # half-diagonals (chosen): nearer windows tell of the same PSF
CELL_ANGLE: Final = math.radians(24.0)  # the same around the centre, where blur changes less (chosen)
MOST_APART: Final = 3.0  # window sides: farther ones are never of one cell (chosen)
MOST_STEPS: Final = 4  # window sides to the nearest seed that count; beyond, the better one wins (chosen)


def _shortlist(windows: Windows) -> list[int]:
    """Windows with the best edges of every ring and octant that lie half a window apart, in their order."""
    ring, octant = _sector_of(windows)
    room = np.full((RINGS, OCTANTS), SHORTLIST_A_SECTOR)
    free = np.ones(len(windows), dtype=bool)
    chosen: list[int] = []
    for i in np.argsort(-edge_score(windows), kind="stable").tolist():
        if free[i] and room[ring[i], octant[i]] > 0:
            chosen.append(i)
            room[ring[i], octant[i]] -= 1
            apart = np.maximum(abs(windows.rows - windows.rows[i]), abs(windows.cols - windows.cols[i]))
            free &= apart >= windows.size / 2.0
    return sorted(chosen)


def _spread(windows: Windows, count: int) -> list[list[int]]:
    """Choose up to `count` windows, given best first, by field cells: seeds, then their neighbours."""
    rows, cols, r, phi = (
        part[:, None] - part for part in (windows.rows, windows.cols, windows.r, windows.phi)
    )
    apart = np.maximum(abs(rows), abs(cols)) / windows.size  # window sides, along the axis with more of them
    turn = abs((phi + math.pi) % (2.0 * math.pi) - math.pi)
    close = (apart < 1.0) | ((turn <= CELL_ANGLE) & (apart <= MOST_APART))
    of_one_cell = close & (abs(r) <= CELL_R)
    # Half a window's distance between any two chosen; a whole one between the seeds, if there is room.
    cells = [[seed] for seed in _seeds(windows, apart, math.ceil(count / PATCHES_A_CELL))]
    free = (apart[[seed for (seed,) in cells]] >= 0.5).all(axis=0)
    while sum(map(len, cells)) < count and free.any():
        room = (cell for cell in cells if len(cell) < MOST_A_CELL and (free & of_one_cell[cell[0]]).any())
        if (home := min(room, key=len, default=None)) is None:  # what is near no cell founds its own
            cells.append(home := [])
        near = of_one_cell[home[0]] if home else free
        home.append(int(np.argmax(free & near)))
        free &= apart[home[-1]] >= 0.5
    return cells


def _seeds(windows: Windows, apart: NDArray[np.float64], count: int) -> list[int]:
    """First windows of cells, from the rings and octants that have the fewest so far."""
    ring, octant = _sector_of(windows)
    # The rings share by area, as far as the photo has anything there: the model needs the corners.
    share = (np.arange(RINGS) + 0.5) * (np.bincount(ring, minlength=RINGS) > 0)
    in_sector = np.zeros((RINGS, OCTANTS), dtype=np.intp)
    nearest = np.full(len(windows), np.inf)
    seeds: list[int] = []
    while len(seeds) < count and (left := np.flatnonzero(nearest >= 1.0)).size:
        fullness = in_sector.sum(axis=1) / np.maximum(share / share.sum(), 1e-9)
        steps = np.minimum(nearest[left], MOST_STEPS).astype(np.intp)
        key = np.lexsort((-steps, fullness[ring[left]], in_sector[ring[left], octant[left]]))
        seeds.append(int(left[key[0]]))  # of equal ones the first, the best: the sort is stable
        in_sector[ring[seeds[-1]], octant[seeds[-1]]] += 1
        nearest = np.minimum(nearest, apart[seeds[-1]])
    return seeds


def _sector_of(windows: Windows) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ring (of equal width in r) and octant of every window."""
    ring = np.minimum((windows.r * RINGS).astype(np.intp), RINGS - 1)
    octant = np.floor(windows.phi * (OCTANTS / (2.0 * math.pi))).astype(np.intp) % OCTANTS
    return ring, octant


_BLOCK: Final = 16  # pixels: a window is eight of them along a side (chosen)
_LEAST_STEP: Final = 64  # pixels between windows: nearer ones share most of their pixels (chosen)
_CLIPPED: Final = 0.02  # of the pixels of a window: statistics of edges suffer beyond
_FULL: Final = 0.98  # of the level at which a plane clips
_SIGNAL: Final = 2.0  # power of gradients over that of noise: below, noise is all there is (chosen)
_MOVES: Final = (-0.8, -0.4, 0.0, 0.4, 0.8)  # within the room of a cell: neighbours do not meet


def spread_evenly(developed: LinearPhoto, *, count: int, size: int) -> Selection:
    """Choose at most `count` windows of side `size`, the same ones always."""
    frame = developed.frame
    _require_room(frame, size)
    ratio, clipped = _blocks(developed)
    patches: list[Patch] = []
    rejected: list[Patch] = []
    for rows, cols in _cells(frame, count, size):
        looked: list[tuple[bool, float, tuple[int, int], Reason]] = []
        for top, left in itertools.product(rows, cols):
            at = round(top / _BLOCK), round(left / _BLOCK)
            part = tuple(slice(start, start + size // _BLOCK) for start in at)
            score = float(np.log10(np.maximum(ratio[part], 1.0)).mean())
            full = float(clipped[part].mean()) > _CLIPPED
            usable = not full and float(ratio[part].mean()) >= _SIGNAL
            looked.append((usable, score, (top, left), "clipped" if full else "flat"))
        usable, score, (top, left), reason = max(looked)
        position = frame.position(top + (size - 1) / 2.0, left + (size - 1) / 2.0)
        if usable:
            patches.append(Patch(top, left, size, position, min(score / 3.0, 1.0)))
        else:
            rejected.append(Patch(top, left, size, position, reason=reason))
    if not patches:
        raise _nothing_usable(str(patch.reason) for patch in rejected)
    return Selection(tuple(patches), tuple(rejected))


def _cells(frame: Frame, count: int, size: int) -> Iterator[tuple[list[int], list[int]]]:
    """Rows and columns of each equal cell at which a window may begin, of the same colour of a mosaic."""
    most = [max((side - size) // _LEAST_STEP + 1, 1) for side in (frame.height, frame.width)]
    down = min(max(round((count * frame.height / frame.width) ** 0.5), 1), most[0], count)
    across = min(max(count // down, 1), most[1])

    def along(side: int, number: int) -> list[list[int]]:
        step, last = (side - size) / number, (side - size) // 2 * 2
        middles = [(i + 0.5) * step for i in range(number)]
        return [[min(max(2 * round((m + a * 0.5 * step) / 2.0), 0), last) for a in _MOVES] for m in middles]

    return itertools.product(along(frame.height, down), along(frame.width, across))


def _blocks(developed: LinearPhoto) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of the gradients of green over that of its noise, and the share of clipped pixels, by block."""
    height, width = (side // _BLOCK * _BLOCK for side in (developed.frame.height, developed.frame.width))
    shape = (height // _BLOCK, width // _BLOCK)
    detail, level, clipped = np.zeros((3, *shape))
    half, limits = _BLOCK // 2, np.array([_FULL * clip for clip in developed.clip], dtype=np.float32)
    for index in range(shape[0]):  # strips: a photo may be mapped from a file
        strip = developed.planes[:, index * _BLOCK : (index + 1) * _BLOCK, :width]
        full = (strip >= limits[:, None, None]).any(axis=0)
        green = np.asarray(strip[1, ::2, ::2], dtype=np.float32)
        power = np.zeros_like(green)
        power[:, :-1] += np.diff(green, axis=1) ** 2
        power[:-1] += np.diff(green, axis=0) ** 2
        detail[index] = power.reshape(half, -1, half).mean(axis=(0, 2))
        level[index] = green.reshape(half, -1, half).mean(axis=(0, 2))
        clipped[index] = full.reshape(_BLOCK, -1, _BLOCK).mean(axis=(0, 2))
    noise = 4.0 * developed.coarse_noise[1].variance(level)  # two differences of two values each
    return detail / np.maximum(noise, 1e-12), clipped


LEAST_PATCHES: Final = 6  # that lie apart: a plane over the field has three unknowns, as many tell if it fits
LEAST_PARTS: Final = 3  # of the picture that they lie in: three places off one line determine a plane
PARTS: Final = 9  # the centre, the four quarters of the picture around it, and the outer end of each


def part_of(position: FieldPosition) -> int:
    """Number of the part of the picture that a place lies in, 0 to `PARTS` - 1, the centre first."""
    zone = zone_of(position.r)
    if zone == "center":
        return 0
    quarter = math.floor(position.phi / (math.pi / 2.0)) % 4
    return 1 + quarter + (4 if zone == "corner" else 0)


def require_enough(patches: Sequence[Patch], *, least: int = LEAST_PATCHES) -> None:
    """Refuse a photo whose detail is too little, or all in one place."""
    single: list[Patch] = []  # those half a side or more from each other
    for patch in patches:
        if all(max(abs(patch.row - k.row), abs(patch.col - k.col)) >= patch.size / 2 for k in single):
            single.append(patch)
    parts = len({part_of(patch.position) for patch in single})
    needed = min(LEAST_PARTS, least)
    if len(single) < least or parts < needed:
        raise NoUsablePatchesError(
            f"fine detail in focus was found in {len(single)} places, in {parts} of {PARTS} parts of the "
            f"picture (the centre, four quarters, their outer ends); a photo counts from {least} places in "
            f"{needed} parts on; take a scene with detail all over, at a low ISO, in its full size"
        )
