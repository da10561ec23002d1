"""PSFs from the slanted edges of a chart: what the edge spreads of a square say of the kernel there.

The edge spread across an edge is the kernel's integral over lines along it. Its derivative's transform is
the kernel's transfer function on the line through zero along the normal n,

    O(f) = sum_u k(u) exp(-2 pi i f n.u)

The edges of one square give two such lines; between them nothing is known. The kernel is that one nearest to
a elliptical g which agrees with them,

    min over k >= 0 of  sum_edges sum_f |(F k)(f) - O(f)|² / s² + (k - g)' T^-1 (k - g)

by the alternating directions of S. Boyd et al., Foundations and Trends in Machine Learning 3, 2011, sec.
5.2: the matrix to invert has a row for each frequency of an edge, not for each pixel.

Two edges tell the variance of g along their normals, n' C n = ln 2 / (2 pi² f50²), but not what joins the
two directions: at a corner of the frame, where u lies between the edges, T and S would be mixed. What a
square does not tell, all squares together do: u turns around the frame while the edges do not. So C is first
fitted to all edges of the chart, smooth over the field h = (x, y), and radially symmetric but for what one
decentred copy adds (K. P. Thompson, JOSA A 22, 2005):

    C(h) = A0 + A1 x + A2 y + |h|² (a I + b u u' + (c.h)(d I + e u u')) + |h|^4 (f I + g u u')

and at each square changed as little as makes it agree with the square's own edges. Along every direction g
has the profile that the chart's edges have in the middle, scaled to one width.

Source of the edge spread: ISO 12233:2017, annex D, in `quality.edge`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg
from scipy.sparse.csgraph import connected_components

from lensmodel.core.errors import LensModelError, NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, centred, gaussian
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, StepHook, ignore_step
from lensmodel.measured.measurer import MeasuredPsf, require_photos
from lensmodel.photo import LinearPhoto
from lensmodel.quality.edge import OVERSAMPLING, EdgeResponse, crossing, slanted_edge
from lensmodel.quality.edge_finder import FoundEdge, find_edges

# Error that no square shows of itself: what lies between two directions. Chosen: an even mixture of a core
# and its aberrations differs by that much from its own two slices' Gaussian
FLOOR: Final = 0.15
# The same of one edge alone: across it only the other edges of the chart say anything (chosen)
_LONE_FLOOR: Final = 0.3
# Cycles/pixel: steps far below what a kernel resolves (chosen)
_FREQUENCIES: Final = np.linspace(0.0, 0.5, 26)
_SCALED: Final = np.linspace(0.0, 3.0, 61)  # Frequencies over that at which the contrast is a half
_FEW: Final = 3  # edges that must reach a frequency of the profile (chosen)
_SLICE_ERROR: Final = 0.01  # s: of an edge of 64 lines at 1 percent noise, demosaiced
# Light differs from g by so much of its peak in the middle; further out by less, as a Gaussian of so many
# times the variance falls (chosen on traced lenses)
_SPREAD, _ENVELOPE = 0.1, 4.0
_ROUNDS: Final = 40  # of ADMM: later ones change nothing that is measured (chosen)
# Edges closer in direction say nearly the same of a kernel; those of a square cross at 90 degrees (chosen)
_CROSSING: Final = math.radians(45.0)
# A corner of a square lies at most so much further out than the middles of windows that hold one edge and
# nothing else: a side of the smallest (chosen)
_CORNER_PX: Final = 64.0
# Pixels from an edge that its line spread is read at: further out is noise; nearer, halos are cut (chosen)
_REACH_PX: Final = 16.0
_TAPER_PX: Final = 4.0  # pixels over which it fades: a sudden end would ring (chosen)
_LEAST_VARIANCE: Final = 0.05  # pixels^2, of a kernel along any direction: a pixel's own box has 1/12
_RIDGE: Final = 0.05  # of the variances: what nothing speaks for stays small (chosen)
_ODD: Final = 0.15  # relative misfit from which on an edge counts less (chosen: ten times an edge's error)
_SYMMETRIC: Final = (0, 2, 9, 10, 15, 16)  # columns of `_columns` that a centred lens has: no ridge


@dataclass(frozen=True, slots=True)
class SlantedEdges:
    """PSFs from the slanted edges of a chart of squares, wherever they are in the frame."""

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
        """Measure a PSF at every square, and at every edge that belongs to none; see `Measurer`."""
        require_photos(self, photos)
        photo = photos[0]
        edges = chart_edges(photo)
        squares = squares_of(edges)
        fields = {channel: VarianceField.fit(_measured(photo, channel, edges)) for channel in channels}
        measured_psfs = []
        for done, square in enumerate(squares, start=1):
            for channel in channels:
                psf = _square_psf(photo, channel, square, fields[channel], size)
                if psf is not None:
                    measured_psfs.append(psf)
            on_step(done, len(squares))
        if not measured_psfs:
            raise NotEnoughEvidenceError("no edge could be measured; is the photo in focus and unclipped?")
        return measured_psfs


def chart_edges(photo: LinearPhoto) -> tuple[FoundEdge, ...]:
    """Find the edges of a photographed chart in its green plane.

    Raises
    ------
    NotEnoughEvidenceError
        If there are fewer than a chart has.
    """
    edges = find_edges(photo.planes[1], noise=photo.noise[1], clip=photo.clip[1])
    if not edges:
        raise NotEnoughEvidenceError(
            "no chart was found; photograph dark squares on bright paper or a checkerboard, turned by 5 "
            "degrees, evenly lit, with 64 pixels or more of flat ground beside each edge"
        )
    return edges


def squares_of(edges: Sequence[FoundEdge]) -> list[tuple[FoundEdge, ...]]:
    """Group edges by the square whose sides they are; an edge that belongs to none comes alone."""
    left = list(edges)
    groups: list[tuple[FoundEdge, ...]] = []
    for side in (-1.0, 1.0):  # dark squares, then bright ones of what is left
        joined = [
            [i != k and _share_corner(a, b, side) for k, b in enumerate(left)] for i, a in enumerate(left)
        ]
        count, labels = connected_components(np.array(joined, dtype=bool).reshape(len(left), len(left)))
        together = [tuple(e for e, l in zip(left, labels, strict=True) if l == n) for n in range(count)]
        groups += [group for group in together if len(group) > 1]
        left = [group[0] for group in together if len(group) == 1]
    return [*groups, *((edge,) for edge in left)]


def _share_corner(a: FoundEdge, b: FoundEdge, side: float) -> bool:
    """Whether two edges meet in a corner and each lies on the dark (-1) or bright (1) side of the other."""
    if _angle_between(a.response.normal, b.response.normal) < _CROSSING:
        return False
    between = np.subtract(b.middle, a.middle)
    normals = [np.array([-math.sin(e.response.normal), math.cos(e.response.normal)]) for e in (a, b)]
    if side * float(between @ normals[0]) <= 0.0 or side * float(-between @ normals[1]) <= 0.0:
        return False
    # the lines p n = p_a n_a and p n = p_b n_b cross here, (row, col)
    corner = np.linalg.solve(np.array(normals), [n @ e.middle for n, e in zip(normals, (a, b), strict=True)])
    return all(min(math.dist(corner, end) for end in edge.ends) < _CORNER_PX for edge in (a, b))


@dataclass(frozen=True, slots=True)
class VarianceField:
    """Covariance of the kernel as a smooth function of the field, from all edges of a chart.

    `coefficients` belong to `_columns`, in square pixels; `profile` is the contrast at `_SCALED`.
    """

    coefficients: NDArray[np.float64]
    profile: NDArray[np.float64]

    @classmethod
    def fit(cls, edges: Sequence[tuple[FieldPosition, EdgeResponse]]) -> VarianceField:
        """Fit n' C(h) n to the variances along the normals; edges that fit badly count less."""
        transfers = [edge_transfer(response) for _, response in edges]
        values = np.array([_variance(transfer) for transfer in transfers])
        design = np.array([_columns(place, response.normal) for place, response in edges])
        usual = float(np.median(values)) if len(values) else 1.0
        ridge = np.full(design.shape[1] if len(values) else 17, _RIDGE / usual)
        ridge[list(_SYMMETRIC)] /= 50.0
        weight = np.ones(len(values))
        coefficients = np.zeros(ridge.size)
        for _ in range(4):
            rows = np.concatenate([design * (weight / values)[:, None], np.diag(ridge)])
            coefficients = np.linalg.lstsq(rows, np.concatenate([weight, np.zeros(ridge.size)]), rcond=None)[
                0
            ]
            misfit = np.abs(design @ coefficients / values - 1.0)
            weight = np.sqrt(np.minimum(1.0, _ODD / np.maximum(misfit, 1e-9)))
        return cls(coefficients, _profile_of(transfers, values))

    def at(self, place: FieldPosition) -> NDArray[np.float64]:
        """Covariance in (row, col)."""
        right, up, both = (
            float(_columns(place, angle) @ self.coefficients) for angle in (0.0, math.pi / 2, math.pi / 4)
        )
        cross = both - (right + up) / 2.0
        return np.array([[up, -cross], [-cross, right]])


def _profile_of(
    transfers: Sequence[NDArray[np.complex128]], variances: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Median contrast over frequency, both scaled to one width; where no edge reaches, a Gaussian's."""
    gaussians = np.exp2(-np.square(_SCALED))
    known = [
        np.interp(_SCALED * _f50(variance), _FREQUENCIES, transfer.real, right=np.nan)
        for transfer, variance in zip(transfers, variances, strict=True)
    ]
    enough = int((np.isfinite(known).sum(axis=0) >= _FEW).sum()) if known else 0
    if not enough:
        return gaussians
    profile = np.nanmedian(np.array(known)[:, :enough], axis=0)
    return np.concatenate([profile, gaussians[enough:] * profile[-1] / gaussians[enough - 1]])


def _f50(variance: float) -> float:
    return math.sqrt(math.log(2.0) / (2.0 * math.pi**2 * variance))


def _elliptical(
    covariance: NDArray[np.float64], profile: NDArray[np.float64], size: int
) -> NDArray[np.float64]:
    """Kernel whose contrast has the profile along every direction, and there the width of the covariance."""
    count = 3 * size
    rows, cols = fft.fftfreq(count)[:, None], fft.rfftfreq(count)[None, :]
    (rr, rc), (_, cc) = covariance
    scaled = np.sqrt(
        (rr * rows**2 + 2.0 * rc * rows * cols + cc * cols**2) * 2.0 * math.pi**2 / math.log(2.0)
    )
    light = fft.irfft2(np.interp(scaled, _SCALED, profile), s=(count, count))
    middle = np.roll(light, (size // 2, size // 2), (0, 1))[:size, :size]
    return np.asarray(as_kernel(np.maximum(middle, 0.0)))


def _columns(place: FieldPosition, normal: float) -> NDArray[np.float64]:
    """Terms of n' C(h) n at a place, for a unit vector n of an angle."""
    x, y = place.r * math.cos(place.phi), place.r * math.sin(place.phi)
    c, s = math.cos(normal), math.sin(normal)
    r2, along = x * x + y * y, (c * x + s * y) ** 2  # along: |h|^2 n'uu'n
    fixed = np.array([c * c, 2.0 * c * s, s * s])
    radial = [r2, along, r2 * x, r2 * y, along * x, along * y, r2 * r2, r2 * along]
    return np.concatenate([fixed, fixed * x, fixed * y, radial])


def _variance(transfer: NDArray[np.complex128]) -> float:
    """Of the Gaussian whose contrast agrees where it falls to a half, or at the highest frequency."""
    contrast = np.abs(transfer)
    f = crossing(_FREQUENCIES, contrast, 0.5)
    level = max(float(np.interp(f, _FREQUENCIES, contrast)), 1e-3)
    return max(-math.log(min(level, 0.99)) / (2.0 * math.pi**2 * f * f), _LEAST_VARIANCE)


def _measured(
    photo: LinearPhoto, channel: Channel, edges: Sequence[FoundEdge]
) -> list[tuple[FieldPosition, EdgeResponse]]:
    """Places and responses of the edges in one colour; those that cannot be measured are left out."""
    plane = photo.planes[CHANNELS.index(channel)]
    responses = []
    for edge in edges:
        row, col, height, width = edge.box
        with contextlib.suppress(LensModelError):
            response = slanted_edge(plane[row : row + height, col : col + width])
            responses.append((photo.frame.position(*edge.middle), response))
    return responses


def _square_psf(
    photo: LinearPhoto, channel: Channel, square: Sequence[FoundEdge], field: VarianceField, size: int
) -> MeasuredPsf | None:
    responses = [response for _, response in _measured(photo, channel, square)]
    if len(responses) < len(square):
        return None
    middle = np.mean([edge.middle for edge in square], axis=0)
    pixel = float(middle[0]), float(middle[1])
    place = photo.frame.position(*pixel)
    try:
        kernel, error = constrained(responses, size, field.at(place), field.profile)
    except LensModelError:
        return None
    return MeasuredPsf(kernel, place, channel, error, pixel, max(max(edge.box[2:]) for edge in square))


def constrained(
    responses: Sequence[EdgeResponse],
    size: int,
    covariance: NDArray[np.floating],
    profile: NDArray[np.floating] | None = None,
) -> tuple[Kernel, float]:
    """Find the kernel that agrees with edge spreads and is nearest to an ellipse, and its expected error.

    Parameters
    ----------
    responses : sequence of EdgeResponse
        Edges near one place.
    size : int
        Odd side of the kernel.
    covariance : ndarray, shape (2, 2)
        Of the kernel as far as it is known otherwise, pixels^2, (row, col); changed as little as makes it
        agree with the edges.
    profile : ndarray, optional
        Contrast at `_SCALED` frequencies; by default a Gaussian's.
    """
    slices = _slices(responses)
    covariance = _agreeing(np.asarray(covariance, dtype=np.float64), slices)
    shape = np.exp2(-np.square(_SCALED)) if profile is None else np.asarray(profile, dtype=np.float64)
    start = _elliptical(covariance, shape, size)
    t = np.arange(size) - size // 2
    rows, values = [], []
    for normal, transfer in slices:
        along = (t[None, :] * math.cos(normal) - t[:, None] * math.sin(normal)).ravel()
        phase = 2.0 * np.pi * _FREQUENCIES[:, None] * along[None, :]
        rows += [np.cos(phase), -np.sin(phase)]
        values += [transfer.real, transfer.imag]
    f, o = np.concatenate(rows), np.concatenate(values)
    g = start.ravel()
    envelope = np.asarray(gaussian(size, _ENVELOPE * covariance)).ravel()
    t2 = (_SPREAD * g.max()) ** 2 * envelope / envelope.max()
    spread = f * t2  # F T
    inverse = linalg.cho_factor(spread @ f.T + 2.0 * _SLICE_ERROR**2 * np.eye(len(o)))
    z, excess = g, np.zeros_like(g)
    for _ in range(_ROUNDS):
        between = (g + z - excess) / 2.0
        k = between + spread.T @ linalg.cho_solve(inverse, o - f @ between)
        z = np.maximum(k + excess, 0.0)
        excess = excess + k - z
    kernel = centred(as_kernel(z.reshape(size, size)))
    unlike = float(np.linalg.norm(kernel - start) / np.linalg.norm(kernel))
    floor = FLOOR if len(slices) > 1 else _LONE_FLOOR
    return kernel, min(math.hypot(floor, unlike / 2.0), 1.0)


def _slices(responses: Sequence[EdgeResponse]) -> list[tuple[float, NDArray[np.complex128]]]:
    """Normals and transfer functions, one for all edges of one direction: opposite ones are conjugate."""
    slices: list[tuple[float, NDArray[np.complex128]]] = []
    left = list(responses)
    while left:
        first = left[0].normal
        own = [r for r in left if _angle_between(first, r.normal) <= _CROSSING / 2]
        left = [r for r in left if _angle_between(first, r.normal) > _CROSSING / 2]
        ahead = [math.cos(r.normal - first) > 0.0 for r in own]
        normal = first + float(
            np.mean(
                [_signed(r.normal - first - (0.0 if a else math.pi)) for r, a in zip(own, ahead, strict=True)]
            )
        )
        transfers = [edge_transfer(r) for r in own]
        mean = np.mean([o if a else o.conj() for o, a in zip(transfers, ahead, strict=True)], axis=0)
        slices.append((normal, mean))
    return slices


def _signed(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


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


def _agreeing(
    covariance: NDArray[np.float64], slices: Sequence[tuple[float, NDArray[np.complex128]]]
) -> NDArray[np.float64]:
    """The nearest covariance whose variance along each normal is that of its edge."""
    rows, values = [], []
    for normal, transfer in slices:
        r, c = -math.sin(normal), math.cos(normal)
        rows.append((r * r, 2 * r * c, c * c))
        values.append(_variance(transfer) - float(np.array([r, c]) @ covariance @ np.array([r, c])))
    # the least-norm solution leaves the term that the edges do not see as it was
    rr, rc, cc = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    spread, axes = np.linalg.eigh(covariance + np.array([[rr, rc], [rc, cc]]))
    return np.asarray(axes @ np.diag(np.maximum(spread, _LEAST_VARIANCE)) @ axes.T)


def _angle_between(first: float, second: float) -> float:
    """Angle between two normals, whichever side is bright: 0 to pi/2."""
    folded = abs(first - second) % math.pi
    return min(folded, math.pi - folded)
