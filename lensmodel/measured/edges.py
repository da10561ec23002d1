"""PSF constraints from slanted edges: what two edge spreads that cross say of the kernel.

The edge spread across an edge is the kernel's integral over lines along it. Its derivative's transform is
the kernel's transfer function on the line through zero along the normal n,

    O(f) = sum_u k(u) exp(-2 pi i f n.u)

Two edges of different direction near one another give two such lines; between them nothing is known. The
kernel is that one nearest to the Gaussian g with the widths of both spreads which agrees with them:

    min over k >= 0 of  sum_edges sum_f |(F k)(f) - O(f)|² / s² + |k - g|² / t²

It is a constraint, not a picture of the kernel: coma and astigmatism across the edges are seen, what
lies between the two directions is not, and the error says so.

Source of the edge spread: ISO 12233:2017, annex D, in `quality.edge`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.least_squares import nonnegative_least_squares
from lensmodel.core.psf import as_kernel, centred, gaussian
from lensmodel.core.types import CHANNELS, Channel, Kernel, StepHook, ignore_step
from lensmodel.measured.measurer import MeasuredPsf, require_photos
from lensmodel.photo import LinearPhoto
from lensmodel.quality.charts import Box
from lensmodel.quality.edge import OVERSAMPLING, EdgeResponse, crossing, slanted_edge
from lensmodel.quality.edge_finder import find_edges

FLOOR: Final = 0.15
"""Error that no pair of edges shows of itself: what lies between two directions. Chosen: an even mixture of
a core and its aberrations differs by that much from its own two slices' Gaussian."""

# Cycles/pixel: steps far below what a kernel resolves (chosen)
_FREQUENCIES: Final = np.linspace(0.02, 0.5, 25)
_SLICE_ERROR: Final = 0.01  # s: of an edge of 64 lines at 1 percent noise
_PIXEL_SPREAD: Final = 0.02  # t: a pixel's light differs so much from a Gaussian's
_CROSSING: Final = math.radians(45.0)
"""Edges closer in direction say nearly the same of a kernel; those of a chart cross at 90 degrees
(chosen)."""
_NEAR: Final = 0.3  # half diagonals between two edges of one constraint: kernels hardly change (chosen)
_REACH_PX: Final = 16.0
"""Pixels from an edge that its line spread is read at: further out is noise; nearer, halos are cut
(chosen)."""
_TAPER_PX: Final = 4.0  # pixels over which it fades: a sudden end would ring (chosen)


@dataclass(frozen=True, slots=True)
class SlantedEdges:
    """PSF constraints from the slanted edges of a chart, wherever they are in the frame."""

    name: ClassVar[str] = "edges"
    version: ClassVar[int] = 1
    photos: ClassVar[int] = 1

    def measure(
        self,
        photos: Sequence[LinearPhoto],
        *,
        size: int,
        channels: Sequence[Channel] = CHANNELS,
        on_step: StepHook = ignore_step,
    ) -> list[MeasuredPsf]:
        """Measure a PSF between every two near edges that cross; see `Measurer`."""
        require_photos(self, photos)
        photo = photos[0]
        boxes = find_edges(photo.planes[1], photo.frame, noise=photo.noise[1], clip=photo.clip[1])
        if not boxes:
            raise NotEnoughEvidenceError(
                "no slanted edges are seen; photograph an ISO 12233 chart or a checkerboard that leans by 5 "
                "degrees, evenly lit, with 64 pixels or more of flat ground beside each edge"
            )
        pairs = _crossing_pairs(photo, boxes)
        if not pairs:
            raise NotEnoughEvidenceError(
                f"{len(boxes)} edges are seen, but no two that cross near one another; use a chart with "
                "edges along rows and columns everywhere"
            )
        measured_psfs = []
        for done, pair in enumerate(pairs, start=1):
            for channel in channels:
                psf = _pair_psf(photo, channel, pair, size)
                if psf is not None:
                    measured_psfs.append(psf)
            on_step(done, len(pairs))
        if not measured_psfs:
            raise NotEnoughEvidenceError("no edge could be measured; is the photo in focus and unclipped?")
        return measured_psfs


def _crossing_pairs(photo: LinearPhoto, boxes: Sequence[Box]) -> list[tuple[Box, Box]]:
    """Every edge with the nearest that crosses it; each pair once."""
    measured = [(box, _measured(photo, "g", box)) for box in boxes]
    known = [(box, response) for box, response in measured if response is not None]
    pairs: dict[frozenset[Box], tuple[Box, Box]] = {}
    for box, response in known:
        others = [
            (_apart(box, other), other)
            for other, second in known
            if _angle_between(response.normal, second.normal) > _CROSSING
        ]
        if not others:
            continue
        distance, nearest = min(others)
        if distance < _NEAR * photo.frame.half_diagonal:
            pairs.setdefault(frozenset((box, nearest)), (box, nearest))
    return list(pairs.values())


def _pair_psf(photo: LinearPhoto, channel: Channel, pair: tuple[Box, Box], size: int) -> MeasuredPsf | None:
    responses = [_measured(photo, channel, box) for box in pair]
    slices = [response for response in responses if response is not None]
    if len(slices) < len(pair):
        return None
    try:
        kernel, error = constrained(slices, size)
    except LensModelError:
        return None
    middle = np.mean([_middle(box) for box in pair], axis=0)
    pixel = float(middle[0]), float(middle[1])
    side = max(max(box[2:]) for box in pair)
    return MeasuredPsf(kernel, photo.frame.position(*pixel), channel, error, pixel, side)


def constrained(responses: Sequence[EdgeResponse], size: int) -> tuple[Kernel, float]:
    """Find the kernel that agrees with edge spreads of two or more directions."""
    normals = [response.normal for response in responses]
    if len(normals) < 2 or max(_angle_between(normals[0], n) for n in normals[1:]) < _CROSSING / 2:
        raise InvalidInputError("edges of two directions are needed; these all have one")
    start = gaussian(size, _covariance(responses))
    t = np.arange(size) - size // 2
    rows, values = [], []
    for response in responses:
        along = (t[None, :] * math.cos(response.normal) - t[:, None] * math.sin(response.normal)).ravel()
        phase = 2.0 * np.pi * _FREQUENCIES[:, None] * along[None, :]
        transfer = edge_transfer(response)
        rows += [np.cos(phase), -np.sin(phase)]
        values += [transfer.real, transfer.imag]
    f, o = np.concatenate(rows) / _SLICE_ERROR, np.concatenate(values) / _SLICE_ERROR
    prior = np.asarray(start).ravel()
    a = f.T @ f + np.eye(size * size) / _PIXEL_SPREAD**2
    b = f.T @ o + prior / _PIXEL_SPREAD**2
    k = nonnegative_least_squares(a, b, prior.copy()).reshape(size, size)
    kernel = centred(as_kernel(k))
    unlike = float(np.linalg.norm(kernel - start) / np.linalg.norm(kernel))
    return kernel, min(math.hypot(FLOOR, unlike / 2.0), 1.0)


def edge_transfer(response: EdgeResponse) -> NDArray[np.complex128]:
    """Transfer function along the normal at `_FREQUENCIES`, its phase from the middle of the light.

    The derivative of the profile, tapered where only noise is left, transformed; what the difference over
    two bins and the bins themselves take off is put back, as `quality.edge` does.
    """
    distance, esf = response.esf_distance, response.esf
    lsf = (esf[2:] - esf[:-2]) / 2.0
    place = distance[1:-1]
    peak = float(place[int(np.argmax(np.convolve(lsf, np.ones(OVERSAMPLING), "same")))])
    away = np.abs(place - peak)
    taper = np.clip((_REACH_PX + _TAPER_PX - away) / _TAPER_PX, 0.0, 1.0)
    lsf = lsf * taper * taper * (3.0 - 2.0 * taper)
    total = float(lsf.sum())
    middle = float((lsf * place).sum()) / total
    wave = np.exp(-2j * np.pi * _FREQUENCIES[:, None] * (place - middle)[None, :])
    known = np.sinc(2.0 * _FREQUENCIES / OVERSAMPLING) * np.sinc(_FREQUENCIES / OVERSAMPLING)
    return np.asarray((wave @ lsf) / total / known, dtype=np.complex128)


def _covariance(responses: Sequence[EdgeResponse]) -> NDArray[np.float64]:
    """Covariance whose spread along each normal is that of its edge: exp(-2 pi² s² f²) = 1/2 at MTF50."""
    rows, values = [], []
    for response in responses:
        f50 = max(crossing(_FREQUENCIES, np.abs(edge_transfer(response)), 0.5), 1e-2)
        r, c = -math.sin(response.normal), math.cos(response.normal)
        rows.append((r * r, 2 * r * c, c * c))
        values.append(math.log(2.0) / (2.0 * math.pi**2 * f50**2))
    # of two edges, the least-norm solution leaves the term that neither sees at its smallest
    rr, rc, cc = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    covariance = np.array([[rr, rc], [rc, cc]])
    spread, axes = np.linalg.eigh(covariance)
    return np.asarray(axes @ np.diag(np.maximum(spread, 0.05)) @ axes.T)


def _measured(photo: LinearPhoto, channel: Channel, box: Box) -> EdgeResponse | None:
    row, col, height, width = box
    try:
        return slanted_edge(photo.planes[CHANNELS.index(channel), row : row + height, col : col + width])
    except LensModelError:
        return None


def _middle(box: Box) -> tuple[float, float]:
    return box[0] + (box[2] - 1) / 2.0, box[1] + (box[3] - 1) / 2.0


def _apart(first: Box, second: Box) -> float:
    return math.dist(_middle(first), _middle(second))


def _angle_between(first: float, second: float) -> float:
    """Angle between two normals, whichever side is bright: 0 to pi/2."""
    folded = abs(first - second) % math.pi
    return min(folded, math.pi - folded)
