"""Choose the windows of a photo that tell about the PSF: by the r-map, or by learned good regions."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, NoUsablePatchesError
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, Frame, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.patches import checks, spread
from lensmodel.patches.checks import Details
from lensmodel.patches.good_regions import GoodRegionsSelector
from lensmodel.patches.rmap import RMapSelector, edge_score
from lensmodel.patches.windows import (
    BLOCKS_A_SIDE,
    MAX_REJECTIONS,
    Patch,
    Reason,
    Rejection,
    Selection,
    Windows,
    measure_blocks,
    windows_of,
)

logger = logging.getLogger(__name__)

SMALLEST_PATCH: Final = 64  # pixels: the least that estimators take
CLIPPED_LIMIT: Final = 0.005  # share of a window's pixels (chosen): a few specular points do little harm
BLOB_LIMIT: Final = (
    20  # connected clipped pixels: a larger area has an edge whose profile is cut off (chosen)
)
DARK_LIMIT: Final = 0.5  # share of a window's pixels: the other half still has edges (chosen)
FLAT_CONTRAST: Final = 4.0  # variance of signal over noise: below, noise decides the estimate (chosen)
FLAT_EIGENVALUE: Final = 10.0  # smaller eigenvalue of the structure tensor over that of noise (chosen)
ONE_DIRECTION_RATIO: Final = 0.05  # the same over the larger one: a line has next to nothing (chosen)
SECTOR_INFORMATION: Final = float(np.log(2.0))  # power twice that of noise, signal as strong as noise
PERIOD_LIMIT: Final = 0.8  # a repetition is as alike as that, other scenes seldom (chosen)
BLOCKINESS_LIMIT: Final = 1.8  # chance gives a little more than 1, and twice is plain to see (chosen)
JPEG_WEIGHT: Final = 0.3  # JPEG files were sharpened and gamma-coded: their patches count for less
EVIDENCE_FLOOR: Final = 0.25  # bits a frequency: signal as strong as noise over a quarter of them
SHORTLIST_A_SECTOR: Final = 8  # windows that the costlier scores look at: several times those taken (chosen)

_ADVICE: Final[dict[str, str]] = {
    "flat": "take a scene with more fine detail, at a lower ISO",
    "dark": "expose longer",
    "clipped": "expose shorter",
    "one-directional": "take a scene with edges in all directions",
    "periodic": "avoid fences, grids and facades that repeat",
    "jpeg-blocks": "use the RAW file or a higher JPEG quality",
    "border": "crop the empty border away",
}


class Selector(Protocol):
    """Says how much each window tells about the PSF (Hirsch and Schölkopf, ICCV 2015, section 5.2)."""

    def score(self, windows: Windows, looked: Details) -> NDArray[np.float64]:
        """Score the n windows of a photo, shape (n,), 0..1: higher tells more.

        `windows` tells where they lie, their edges, noise and clipping, `looked` their spectra, periods and
        blocks of JPEG.
        """


selectors: Registry[Selector] = Registry(
    "patch selector", {"r-map": RMapSelector, "good-regions": GoodRegionsSelector}, "lensmodel.selectors"
)


def select(
    plane: Plane,
    noise: NoiseModel,
    frame: Frame,
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
    them. `coarse_noise` is that between 0.1 and 0.4 cycles/pixel where it is more than `noise`.
    """
    if plane.shape != (frame.height, frame.width):
        raise InvalidInputError(f"the plane is {plane.shape}, the frame {frame.height} x {frame.width}")
    if count < 1:
        raise InvalidInputError(f"count must be at least 1, got {count}")
    chooser = selectors.resolve(selector)
    side = _block_side(frame, size)
    windows = windows_of(measure_blocks(plane, noise, side, clip, on_step), frame, noise)
    reasons = first_reasons(windows)
    usable = np.flatnonzero(reasons == "")
    short = usable[spread.shortlist(windows.take(usable), edge_score(windows)[usable], SHORTLIST_A_SECTOR)]
    reasons[np.setdiff1d(usable, short)] = "duplicate"
    chosen: list[tuple[int, int]] = []
    score = np.zeros(len(windows))
    if short.size:
        looked = checks.details_of(plane, windows.take(short), clip, coarse_noise)
        reasons[short] = second_reasons(looked)
        fine = reasons[short] == ""
        left = short[fine]
        score[left] = chooser.score(windows.take(left), looked.take(fine))
        if left.size:
            picks = spread.spread_windows(windows.take(left), score[left], count)
            chosen = [(int(left[i]), cell) for i, cell in picks]
    if not chosen:
        raise NoUsablePatchesError(_nothing_usable(Counter(reasons.tolist())))
    taken = np.array([i for i, _ in chosen])
    reasons[np.setdiff1d(np.flatnonzero(reasons == ""), taken)] = "duplicate"
    reasons[taken] = ""
    weight = JPEG_WEIGHT if jpeg else 1.0
    patches = []
    for i, cell in chosen:
        position = FieldPosition(min(float(windows.r[i]), 1.0), float(windows.phi[i]))
        corner = int(windows.rows[i]), int(windows.cols[i])
        patches.append(Patch(*corner, windows.size, position, float(score[i]) * weight, cell))
    counts = Counter(reason for reason in reasons.tolist() if reason)
    logger.info("chose %d of %d windows; rejected: %s", len(patches), len(windows), dict(counts))
    return Selection(tuple(patches), _rejections(windows, reasons))


def _block_side(frame: Frame, size: int) -> int:
    """Side of the blocks of windows of `size` pixels, or of those that fit."""
    if size < SMALLEST_PATCH:
        raise InvalidInputError(f"patches need at least {SMALLEST_PATCH} px, got {size}")
    shorter = min(frame.height, frame.width)
    if shorter < SMALLEST_PATCH:
        raise NoUsablePatchesError(
            f"the photo is {frame.width} x {frame.height} px, a patch needs {SMALLEST_PATCH}; "
            "use the photo in its full size"
        )
    fitting = max(shorter // 4, min(shorter, 2 * SMALLEST_PATCH))
    return min(size, fitting) // BLOCKS_A_SIDE


def first_reasons(windows: Windows) -> NDArray[np.str_]:
    """Reason of each window from block sums alone, the first that holds; empty where none does."""
    small, large = windows.eigenvalues.T
    return _first(
        ("border", windows.missing > 0.0),
        ("clipped", windows.clipped > CLIPPED_LIMIT),
        ("dark", windows.dark > DARK_LIMIT),
        ("flat", (windows.contrast < FLAT_CONTRAST) | (large < FLAT_EIGENVALUE)),
        ("one-directional", small < ONE_DIRECTION_RATIO * large),
        ("flat", small < FLAT_EIGENVALUE),
    )


def second_reasons(looked: Details) -> NDArray[np.str_]:
    """Reason of each window from its own pixels; empty where none holds."""
    return _first(
        ("clipped", looked.blob > BLOB_LIMIT),
        ("flat", looked.evidence < EVIDENCE_FLOOR),
        ("periodic", looked.period > PERIOD_LIMIT),
        ("jpeg-blocks", looked.blockiness > BLOCKINESS_LIMIT),
        ("one-directional", looked.information[:, 0].min(axis=1) < SECTOR_INFORMATION),
    )


def _first(*tests: tuple[Reason, NDArray[np.bool_]]) -> NDArray[np.str_]:
    return np.select([test for _, test in tests], [reason for reason, _ in tests], default="").astype("U16")


def _rejections(windows: Windows, reasons: NDArray[np.str_]) -> tuple[Rejection, ...]:
    """Return the rejected windows, thinned evenly in reading order when there are too many."""
    at = np.flatnonzero(reasons != "")
    if at.size > MAX_REJECTIONS:
        at = at[np.linspace(0, at.size - 1, MAX_REJECTIONS).astype(np.intp)]
    return tuple(
        Rejection(int(windows.rows[i]), int(windows.cols[i]), windows.size, str(reasons[i]))  # type: ignore[arg-type]  # only reasons are stored
        for i in at
    )


def _nothing_usable(counts: Counter[str]) -> str:
    total = sum(counts.values())
    if total == 0:
        return "no part of the photo is large enough for a patch; use the photo in its full size"
    reason, times = counts.most_common(1)[0]
    listed = ", ".join(f"{name} {number}" for name, number in counts.most_common())
    return (
        f"none of {total} windows is usable ({listed}); {times} are rejected as {reason}: "
        f"{_ADVICE.get(reason, 'use another photo')}"
    )
