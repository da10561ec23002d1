"""What one patch of a photo tells about the blur, as numbers that the network reads.

They are, for the samples of each colour in the mosaic, the logarithm of the noise-corrected power spectrum in
rings and directions, and for interpolated green how the gradient across edges correlates with itself along
eight directions: its third and seventh powers belong to the strongest edges, are signed (a halo is negative)
and differ between the two sides of an edge where the PSF is one-sided (coma).

Every place is turned into the octant 0 <= y <= x. An octant is a triple of flags: mirror x, then mirror y,
then exchange x and y. Places have x to the right and y upwards; arrays have rows downwards.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lensmodel.core.numerics import jit
from lensmodel.core.types import Plane

OCTANTS: Final = 8
DIRECTIONS: Final = 16  # of statistics over the full circle, counter-clockwise from the right


def octant_of(xy: NDArray[np.floating]) -> NDArray[np.int64]:
    """Octant of places, shape (..., 2): 1 if x is mirrored, plus 2 if y is, plus 4 if they are exchanged."""
    x, y = xy[..., 0], xy[..., 1]
    return (x < 0) + 2 * (y < 0) + 4 * (np.abs(y) > np.abs(x))


def to_octant_place(octant: NDArray[np.int64], xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Turn places of shape (..., 2) by octants that broadcast against (...)."""
    x = np.where(octant & 1, -xy[..., 0], xy[..., 0])
    y = np.where(octant & 2, -xy[..., 1], xy[..., 1])
    swap = (octant & 4) > 0
    return np.stack([np.where(swap, y, x), np.where(swap, x, y)], -1)


def direction_order(octant: int) -> NDArray[np.int64]:
    """Where each of the 16 directions of an array in the octant's frame is found in the image's frame."""
    k = np.arange(DIRECTIONS)
    if octant & 1:
        k = (8 - k) % DIRECTIONS
    if octant & 2:
        k = -k % DIRECTIONS
    if octant & 4:
        k = (4 - k) % DIRECTIONS
    return np.argsort(k)


def to_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) into the frame of an octant."""
    if octant & 1:
        image = image[..., ::-1]
    if octant & 2:
        image = image[..., ::-1, :]
    return np.swapaxes(image[..., ::-1, ::-1], -1, -2) if octant & 4 else image


def relative_octant(query: NDArray[np.int64], sample: NDArray[np.int64]) -> NDArray[np.int64]:
    """Symmetry that leads from the frame of a sample's octant to that of the query's, 0..7."""
    return _RELATIVE[query, sample]


# to_octant_place as matrices; the inverse of one is its transpose
_MATRICES: Final = to_octant_place(np.arange(OCTANTS)[:, None], np.eye(2)).mT
_PRODUCTS: Final = _MATRICES[:, None] @ _MATRICES.mT[None]
_RELATIVE: Final = (_PRODUCTS[:, :, None] == _MATRICES).all(axis=(-1, -2)).argmax(axis=-1)


def from_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) back from the frame of an octant."""
    return to_octant_image(int(_RELATIVE[0, octant]), image)


WINDOW: Final = 128  # pixels: holds several times the widest kernel, and little of the field (chosen)
# edges, cycles/pixel: from three periods in a window to where green of a Bayer mosaic still tells
_RINGS: Final = (0.022, 0.04, 0.056, 0.075, 0.1, 0.128, 0.158, 0.19, 0.225, 0.265, 0.31, 0.36, 0.43)
_GREEN_RINGS, _COLOUR_RINGS, _LOW_RINGS = 12, 9, 2
_SHIFTS: Final = (1, 2, 3, 4, 6, 9, 13)  # pixels between correlated gradients
_POWERS: Final = 3  # first (of magnitudes), third and seventh (signed)
_HALF: Final = DIRECTIONS // 2
_FLOOR: Final = 0.1  # of the noise power: least power that is left when the noise is taken away (chosen)
_TINY: Final = 1e-12

_SIZES: Final = {
    "red": _COLOUR_RINGS * _HALF,
    "green": _GREEN_RINGS * _HALF,
    "blue": _COLOUR_RINGS * _HALF,
    "magnitude": len(_SHIFTS) * _HALF,
    "cubed_even": len(_SHIFTS) * _HALF,
    "cubed_odd": len(_SHIFTS) * _HALF,
    "seventh_even": len(_SHIFTS) * _HALF,
    "seventh_odd": len(_SHIFTS) * _HALF,
    "kurtosis": 3 * _HALF,
    "level": 6,
}
"""Groups of numbers in their order; all but `level` have eight directions fastest."""

LENGTH: Final = sum(_SIZES.values())


def group(name: str) -> slice:
    """Where a group of numbers lies."""
    names = list(_SIZES)
    start = sum(_SIZES[n] for n in names[: names.index(name)])
    return slice(start, start + _SIZES[name])


def _bins() -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Ring and direction of each frequency of `rfft2` (-1: none), and how many fall into each."""
    fx = scipy.fft.rfftfreq(WINDOW)[None]
    fy = -scipy.fft.fftfreq(WINDOW)[:, None]  # upwards
    radius = np.hypot(fx, fy)
    direction = np.round(np.arctan2(fy, fx) / (np.pi / _HALF)).astype(int) % _HALF
    ring = np.digitize(radius, _RINGS) - 1
    inside = (ring >= 0) & (ring < _GREEN_RINGS) & ((fx > 0) | (fy > 0))  # each pair of f and -f once
    index = np.where(inside, ring * _HALF + direction, -1).astype(np.int32)
    count = np.bincount(index[inside], minlength=_GREEN_RINGS * _HALF).astype(np.float32)
    return index, count


_BIN, _COUNT = _bins()
_INSIDE: Final = _BIN >= 0
_HANN: Final = np.outer(np.hanning(WINDOW), np.hanning(WINDOW)).astype(np.float32)


def _green_everywhere(mosaic: Plane, colours: NDArray[np.int8]) -> Plane:
    """Green at every pixel but those of the border: its sample, else the mean of green neighbours."""
    mask = (colours == 1).astype(np.float32)
    total, count = (
        part[:-2, 1:-1] + part[2:, 1:-1] + part[1:-1, :-2] + part[1:-1, 2:] for part in (mosaic * mask, mask)
    )
    green = np.zeros_like(mosaic)
    green[1:-1, 1:-1] = np.where(mask[1:-1, 1:-1] > 0, mosaic[1:-1, 1:-1], total / np.maximum(count, 1.0))
    return green


@jit
def _correlated(g: Plane, margin: int, right: int, up: int) -> tuple[float, float, float]:
    """Sums of |g|^p s g(x + d), p = 1, 3, 7, over pixels farther than `margin` from the rim; see below."""
    a, b, e = np.float64(0), np.float64(0), np.float64(0)
    for i in range(margin, g.shape[0] - margin):
        ra, rb, re = np.float32(0), np.float32(0), np.float32(0)
        for j in range(margin, g.shape[1] - margin):
            u, v = g[i, j], g[i - up, j + right]
            square = u * u
            ra += abs(u) * abs(v)
            rb += square * u * v
            re += square * square * square * u * v
        a += ra
        b += rb
        e += re
    return a, b, e


def _edge_correlations(green: Plane) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Correlations (direction, shift, power, side) and kurtoses (direction, 3) of the gradient of green.

    c_p(d) = <|g|^p s g(x + d)> / <|g|^(p+1)> with s the sign of g: p = 1 of magnitudes, 3 and 7 signed; the
    gradient g is across edges of one direction, by Sobel differences; rows grow downwards, y upwards.
    """
    across, upwards = 0.5 * (green[:, 2:] - green[:, :-2]), 0.5 * (green[:-2] - green[2:])
    gx = (across[1:-1] + 0.5 * (across[:-2] + across[2:]))[1:-1, 1:-1]  # green is not known along the border
    gy = (upwards[:, 1:-1] + 0.5 * (upwards[:, :-2] + upwards[:, 2:]))[1:-1, 1:-1]
    margin = _SHIFTS[-1]
    out = np.zeros((_HALF, len(_SHIFTS), _POWERS, 2), np.float32)
    kurtosis = np.zeros((_HALF, 3), np.float32)
    for k in range(_HALF):
        g = _COSINES[k] * gx + _SINES[k] * gy
        inner = g[margin:-margin, margin:-margin]
        scale = max(np.abs(inner).max(), np.float32(1e-9))
        g, inner = g / scale, inner / scale
        square = inner * inner
        m1, m2 = np.abs(inner).sum(dtype=np.float64), square.sum(dtype=np.float64) + 1e-12
        m4, m8 = (np.square(square**n).sum(dtype=np.float64) + 1e-12 for n in (1, 2))
        moments = m4 / (m2 * m2), m2 / (m1 * m1 + 1e-12), m8 / (m4 * m4)
        kurtosis[k] = np.log(np.multiply(moments, inner.size))
        for d in range(len(_SHIFTS)):
            for side, sign in enumerate((1, -1)):
                sums = _correlated(g, margin, sign * _DX[k, d], sign * _DY[k, d])
                out[k, d, :, side] = np.divide(sums, (m2, m4, m8))
    return out, kurtosis


_ANGLES: Final = np.arange(_HALF) * np.pi / _HALF
_COSINES: Final = np.cos(_ANGLES).astype(np.float32)
_SINES: Final = np.sin(_ANGLES).astype(np.float32)
_DX: Final = np.round(np.outer(np.cos(_ANGLES), _SHIFTS)).astype(np.int64)
_DY: Final = np.round(np.outer(np.sin(_ANGLES), _SHIFTS)).astype(np.int64)


def patch_statistics(
    mosaic: Plane, colours: NDArray[np.int8], read: float, shot: float
) -> NDArray[np.float32]:
    """Statistics of a patch in the frame of the image, (LENGTH,), finite for every finite input.

    `mosaic` and `colours` are (WINDOW, WINDOW): samples in linear light, white 1, and the colour of each,
    0 red, 1 green, 2 blue. The variance of the noise is read^2 + shot * value.
    """
    powers, level = [], []
    for colour, rings in ((0, _COLOUR_RINGS), (1, _GREEN_RINGS), (2, _COLOUR_RINGS)):
        mask = (colours == colour).astype(np.float32)
        weight = _HANN * mask
        mean = float((mosaic * mask).sum() / max(float(mask.sum()), 1.0))
        middle = float((mosaic * weight).sum() / max(float(weight.sum()), _TINY))
        spectrum = scipy.fft.rfft2((mosaic - np.float32(middle)) * weight)
        noise = float((_HANN * weight).sum()) * (read * read + shot * max(mean, 0.0)) + _TINY
        squared = spectrum.real**2 + spectrum.imag**2
        means = (np.bincount(_BIN[_INSIDE], squared[_INSIDE]) / _COUNT).astype(np.float32)
        power = np.maximum(means - noise, 0.0) + _FLOOR * noise
        log_power = np.log(power)
        low = float(np.log(power[: _LOW_RINGS * _HALF].mean()))
        powers.append(log_power[: rings * _HALF] - low)
        level += [np.log(noise) - low, 0.5 * low - np.log(max(mean, 0.0) + 1e-3) - 3.0]
    sides, kurtosis = _edge_correlations(_green_everywhere(mosaic, colours))
    even, odd = 0.5 * (sides[..., 0] + sides[..., 1]), sides[..., 0] - sides[..., 1]
    edges = [even[..., 0], even[..., 1], odd[..., 1], even[..., 2], odd[..., 2], kurtosis]
    return np.concatenate([*powers, *(edge.T.ravel() for edge in edges), np.array(level)]).astype(np.float32)


def to_octant(statistics: NDArray[np.float32], xy: NDArray[np.floating]) -> NDArray[np.float32]:
    """Turn statistics (n, LENGTH) into the frames of the octants of their places (n, 2)."""
    octants = octant_of(np.asarray(xy))
    out = np.empty_like(statistics)
    for octant in np.unique(octants):
        index, sign = _order(int(octant))
        out[octants == octant] = statistics[octants == octant][:, index] * sign
    return out


def _order(octant: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Where each number is found in the frame of the image, and its sign there."""
    found = direction_order(octant)[:_HALF]
    place, sign = found % _HALF, np.where(found < _HALF, 1.0, -1.0)
    index, signs = np.arange(LENGTH), np.ones(LENGTH, np.float32)
    turned = group("level").start
    index[:turned] = (np.arange(0, turned, _HALF)[:, None] + place).ravel()
    for name in ("cubed_odd", "seventh_odd"):
        signs[group(name)] = np.tile(sign, len(_SHIFTS))
    return index, signs
