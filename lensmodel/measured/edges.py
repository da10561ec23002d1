"""PSFs from the squares of a chart: what their edges and corners say of the kernel there.

The edge spread across an edge is the kernel's integral over lines along it. Its derivative's transform is
the kernel's transfer function on the line through zero along the normal n,

    O(f) = sum_u k(u) exp(-2 pi i f n.u)

The edges of one square give two such lines; at a corner of the frame, where u lies between the edges, T and S
would be mixed. What lies between the lines is seen at the corners of the square: the mixed derivative of a
blurred corner is the kernel itself. So the kernel is taken for a mixture of Gaussians,

    k(x) = sum_i w_i N(x; m_i, C_i),

two of any shape and a round halo, and fitted by least squares to the transfer functions of the edges and to
the pixels of the corners that the sensor measured. A corner is drawn sharp, from the areas that its edges cut
off pixels, and blurred by k; the levels of its four quarters, small shifts of both edges and a slope of the
light are linear, and solved for anew in each step (G. Golub and V. Pereyra, SIAM J. Numer. Anal. 10, 1973).
Squares and checkerboards are alike in this.

Source of the edge spread: ISO 12233:2017, annex D, in `quality`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize
from scipy.sparse.csgraph import connected_components

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.numerics import on_simplex
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Channel, Kernel, StepHook
from lensmodel.measured.measurer import Found, Measurer, Prepared, Window
from lensmodel.photo import LinearPhoto
from lensmodel.quality import OVERSAMPLING, FoundEdge, crossing, edge_area, find_edges, slanted_edge

_FREQUENCIES: Final = np.linspace(0.0, 0.5, 26)  # cycles/pixel: finer than a kernel resolves (chosen)
_SLICE_ERROR: Final = 0.02  # of a transfer function: of an edge of 64 lines at 1 percent noise
_CROSSING: Final = math.radians(45.0)  # edges closer in direction say nearly the same of a kernel (chosen)
_CORNER_PX: Final = 64.0  # of a corner from the end of its edges: a side of the smallest window (chosen)
_REACH_PX: Final = 16.0  # from an edge that its line spread is read at: further out is noise (chosen)
_TAPER_PX: Final = 4.0  # pixels over which it fades: a sudden end would ring (chosen)
_LEAST_PX: Final = 0.15  # standard deviation of a Gaussian: narrower looks the same to pixels (chosen)
_HALF: Final = 9  # pixels around a corner that are compared: 6 to 20 come to the same (chosen)
_SPARE_PX: Final = 16  # around them, which the blur of the rim of what is drawn reaches (chosen)
# Where the fit begins, round: widths of the core and of the wider Gaussian over that of the edges, weights of
# the latter and of the halo over that of the core, and the halo's width. And a weak prior around it: standard
# deviations of the logarithms, of the factors' lower corners, and of the two means in pixels (chosen)
_CORE, _WIDE, _START_WEIGHTS, _HALO_PX = 0.75, 1.7, (0.37, 0.05), 3.5
_SPREAD: Final = np.array([1.0] * 6 + [0.5] * 4 + [1.5, 1.5, 0.4])
_STEPS: Final = 40  # of the fit, at most (chosen)


@dataclass(frozen=True, slots=True)
class SlantedEdges(Measurer):
    """PSFs from the squares of a chart, wherever they are in the frame."""

    name: ClassVar[str] = "edges"
    # kernels are no mixtures of three Gaussians (chosen: half of the squares of five traced lenses are off by
    # .07 to .24)
    floor: ClassVar[float] = 0.15
    shows: ClassVar[str] = "dark squares or a checkerboard with two edges of each and their corner"

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find squares of which two edges and their corner are seen."""
        squares = squares_of(chart_edges(photos[0]))
        return squares, lambda square, channel: _square_psf(photos[0], channel, square, size)


def chart_edges(photo: LinearPhoto) -> tuple[FoundEdge, ...]:
    """Find the edges of a photographed chart in its green plane; refuse one that shows none."""
    edges = find_edges(photo.planes[1], noise=photo.noise[1], clip=photo.clip[1])
    if not edges:
        raise NotEnoughEvidenceError(
            "no chart was found; photograph dark squares on bright paper or a checkerboard, turned by 5 "
            "degrees, evenly lit, with 64 pixels or more of flat ground beside each edge"
        )
    return edges


def squares_of(edges: Sequence[FoundEdge]) -> list[tuple[FoundEdge, ...]]:
    """Group edges by the square whose sides they are; those that belong to none are left out."""
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
    return groups


def _share_corner(a: FoundEdge, b: FoundEdge, side: float) -> bool:
    """Whether two edges meet in a corner and each lies on the dark (-1) or bright (1) side of the other."""
    between, normals = np.subtract(b.middle, a.middle), [_unit(e.response.normal) for e in (a, b)]
    if abs(normals[0] @ normals[1]) > math.cos(_CROSSING):
        return False
    if side * float(between @ normals[0]) <= 0.0 or side * float(-between @ normals[1]) <= 0.0:
        return False
    # the lines p n = p_a n_a and p n = p_b n_b cross here, (row, col)
    corner = np.linalg.solve(np.array(normals), [n @ e.middle for n, e in zip(normals, (a, b), strict=True)])
    return all(min(math.dist(corner, end) for end in edge.ends) < _CORNER_PX for edge in (a, b))


def _unit(normal: float) -> NDArray[np.float64]:
    """Unit vector (row, col) of an angle."""
    return np.array([-math.sin(normal), math.cos(normal)])


# --- what is fitted to --------------------------------------------------------------------------


class _Line(NamedTuple):
    """An edge as measured in one colour: unit normal n (row, col) and p, so that n.x = p on it."""

    normal: NDArray[np.float64]
    place: float
    transfer: NDArray[np.complex128]  # along the normal, at `_FREQUENCIES`
    variance: float  # pixels^2, of the Gaussian whose contrast falls to a half where this does


def _line(photo: LinearPhoto, channel: Channel, edge: FoundEdge) -> _Line:
    """Measure an edge by the transform of its profile's derivative; raises where that fails.

    What the difference over two bins and the bins themselves take off is put back, as `quality` does.
    """
    row, col, side, _ = edge.box
    window = Window.of(photo, channel, (row, col), side)
    response = slanted_edge(window.light, window.measured)
    lsf = (response.esf[2:] - response.esf[:-2]) / 2.0
    place = response.esf_distance[1:-1]
    away = np.abs(place - place[np.argmax(np.convolve(lsf, np.ones(OVERSAMPLING), "same"))])
    taper = np.clip((_REACH_PX + _TAPER_PX - away) / _TAPER_PX, 0.0, 1.0)
    lsf = lsf * taper * taper * (3.0 - 2.0 * taper)
    total = float(lsf.sum())
    middle = float((lsf * place).sum()) / total
    wave = np.exp(-2j * np.pi * _FREQUENCIES[:, None] * (place - middle))
    known = np.sinc(2.0 * _FREQUENCIES / OVERSAMPLING) * np.sinc(_FREQUENCIES / OVERSAMPLING)
    transfer = np.asarray((wave @ lsf) / total / known)
    half = crossing(_FREQUENCIES, np.abs(transfer), 0.5)
    normal = _unit(response.normal)
    on_edge = float(normal @ edge.middle) + response.offset + middle
    return _Line(normal, on_edge, transfer, math.log(2.0) / (2.0 * math.pi**2 * half**2))


_Misfit: TypeAlias = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def _corner(photo: LinearPhoto, channel: Channel, edges: tuple[_Line, _Line]) -> _Misfit | None:
    """How far pixels around a crossing of edges are from a mixture's, over noise; None outside the frame."""
    corner = np.linalg.solve([edge.normal for edge in edges], [edge.place for edge in edges])
    row, col = np.rint(corner).astype(int) - _HALF
    side = 2 * _HALF + 1
    if min(row, col) < 0 or row + side > photo.frame.height or col + side > photo.frame.width:
        return None
    window = Window.of(photo, channel, (int(row), int(col)), side)
    if (good := window.measured).sum() < side:
        return None
    values = window.light[good] / math.sqrt(float(window.variance[0, 0]))
    slope = np.column_stack([np.ones(values.size), np.argwhere(good) / _HALF - 1.0])  # of the light
    count = int(fft.next_fast_len(side + 2 * _SPARE_PX, real=True))
    seen = np.zeros((count, count), dtype=np.bool_)
    seen[_SPARE_PX : _SPARE_PX + side, _SPARE_PX : _SPARE_PX + side] = good
    sharp = _drawn(corner - (row - _SPARE_PX, col - _SPARE_PX), [edge.normal for edge in edges], count)
    frequencies = fft.fftfreq(count)[:, None], fft.rfftfreq(count)[None, :]

    def misfit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the best levels, shifts of the edges and slope of the light leave."""
        light = fft.irfft2(sharp * _mixture(vector, *frequencies), (count, count))[:, seen]
        columns = np.column_stack([slope, light.T])
        gram = columns.T @ columns
        terms = np.linalg.solve(gram + 1e-9 * np.trace(gram) * np.eye(len(gram)), columns.T @ values)
        return np.asarray(values - columns @ terms)

    return misfit


def _drawn(
    corner: NDArray[np.float64], normals: Sequence[NDArray[np.float64]], count: int
) -> NDArray[np.complex128]:
    """Spectra of half planes beyond two edges, of their product, and of what moves of the edges change."""
    rows, cols = np.arange(count)[:, None] - corner[0], np.arange(count)[None, :] - corner[1]
    first, second = (edge_area(rows, cols, math.atan2(-n[0], n[1])) for n in normals)
    down, across = fft.fftfreq(count)[:, None], fft.rfftfreq(count)[None, :]
    # no pixel has blurred them: the box in which areas are counted is divided out
    spectra = fft.rfft2([first, second, first * second]) / (np.sinc(down) * np.sinc(across))
    moves = [2j * np.pi * (n[0] * down + n[1] * across) for n in normals]
    changes = [spectra[0] * moves[0], spectra[1] * moves[1], *(spectra[2] * move for move in moves)]
    return np.concatenate([spectra, changes])


# --- the kernel ---------------------------------------------------------------------------------


def _mixture(
    vector: NDArray[np.float64], rows: NDArray[np.float64], cols: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Transfer function of three Gaussians at frequencies in cycles/pixel.

    By two Cholesky factors, two means (row, col), and logarithms of two weights and of the third's width.
    """
    shapes = [*vector[:6].reshape(2, 3), (vector[12], 0.0, vector[12])]
    means = [*vector[6:10].reshape(2, 2), (0.0, 0.0)]
    weights = np.exp([0.0, *vector[10:12]])
    total: NDArray[np.complex128] = np.zeros(np.broadcast(rows, cols).shape, dtype=np.complex128)
    for weight, (down, across), (a, b, c) in zip(weights / weights.sum(), means, shapes, strict=True):
        rr, rc, cc = math.exp(a) ** 2, math.exp(a) * b, b * b + math.exp(c) ** 2  # covariance LL'
        spread = rr * rows**2 + 2.0 * rc * rows * cols + cc * cols**2
        turn = 2j * np.pi * (rows * down + cols * across)
        total = total + weight * np.exp(-2.0 * np.pi**2 * spread - turn)
    return total


def _kernel(vector: NDArray[np.float64], size: int) -> Kernel:
    """Kernel of pixels of a mixture, by its transfer function up to the highest frequency that they hold."""
    count = 3 * size
    light = fft.irfft2(
        _mixture(vector, fft.fftfreq(count)[:, None], fft.rfftfreq(count)[None, :]), (count,) * 2
    )
    middle = np.roll(light, (size // 2, size // 2), (0, 1))[:size, :size]
    return as_kernel(on_simplex(middle.ravel(), 1.0).reshape(size, size))


def _square_psf(photo: LinearPhoto, channel: Channel, square: Sequence[FoundEdge], size: int) -> Found:
    """Fit the kernel of one square in one colour."""
    lines = [_line(photo, channel, edge) for edge in square]
    pairs = [(a, b) for a, b in combinations(lines, 2) if abs(a.normal @ b.normal) < math.cos(_CROSSING)]
    corners = [seen for pair in pairs if (seen := _corner(photo, channel, pair)) is not None]
    if not corners:
        raise NotEnoughEvidenceError("no corner of the square is seen")

    def misfit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        waves = [_mixture(vector, *(_FREQUENCIES * n for n in line.normal)) - line.transfer for line in lines]
        slices = [part / _SLICE_ERROR for wave in waves for part in (wave.real, wave.imag)]
        return np.concatenate([*slices, *(corner(vector) for corner in corners)])

    width = math.sqrt(float(np.mean([line.variance for line in lines])))
    shapes = [(math.log(share * width), 0.0, math.log(share * width)) for share in (_CORE, _WIDE)]
    start = np.concatenate([*shapes, [0.0] * 4, np.log(_START_WEIGHTS), [math.log(_HALO_PX)]])
    low = np.full(start.size, -np.inf)
    low[[0, 2, 3, 5]] = math.log(_LEAST_PX)
    start = np.maximum(start, low + 1e-3)
    result = optimize.least_squares(
        lambda vector: np.concatenate([misfit(vector), (vector - start) / _SPREAD]),
        start, bounds=(low, np.inf), x_scale=_SPREAD, max_nfev=_STEPS, ftol=1e-7,
    )  # fmt: skip
    return Found(_kernel(result.x, size), 0.0, np.mean([edge.middle for edge in square], axis=0))
