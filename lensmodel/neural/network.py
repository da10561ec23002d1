"""The regression with learned kernels: patches of a photo in, the PSF at any place and settings out.

`lensmodel.blind.learned` takes the patches from photos, `lensmodel.model.learned_field` asks of those of all
photos, and `lab.population` trains the network.

What a patch tells of the blur becomes numbers: for the samples of each colour in the mosaic, the logarithm of
the noise-corrected power spectrum in rings and directions, and for interpolated green how the gradient across
edges correlates with itself along eight directions: its third and seventh powers belong to the strongest
edges, are signed (a halo is negative) and differ between the two sides of an edge where the PSF is one-sided
(coma).

These statistics become a token; patches of one photo look at each other (a patch out of focus shows beside
sharp ones), photos never do, so that a new photo leaves the tokens of others as they are. A query, a place
and settings, starts from what is usual there and takes up the samples by attention::

    a = softmax_j( q k_j / sqrt(d) + (q P) phi_j - g |distances_j| ),    out = sum_j a_j (v_j + phi_j R)

which is Nadaraya-Watson regression (M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015,
eq. 4) with learned weights and values; phi_j tells how sample j lies to the query. One more logit, of
nothing, lets few or far samples count little. The answer are logits of a kernel at two scales, a softmax of
which is non-negative with sum 1, and the expected error.

Features of places and settings are the same in training and in use. A lens has no preferred side: every place
is turned into the octant 0 <= y <= x, and what the network says is turned back. An octant is a triple of
flags: mirror x, then mirror y, then exchange x and y. Places have x to the right and y upwards; arrays have
rows downwards.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import erf, softmax

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.psf import KINDS, PatchKind
from lensmodel.core.types import LensSettings, Plane

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


def to_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) into the frame of an octant."""
    if octant & 1:
        image = image[..., ::-1]
    if octant & 2:
        image = image[..., ::-1, :]
    return np.swapaxes(image[..., ::-1, ::-1], -1, -2) if octant & 4 else image


# `to_octant_place` as matrices, whose transposes undo them; and which of them turns octant b into a, [a, b]
_MATRICES: Final = to_octant_place(np.arange(OCTANTS)[:, None], np.eye(2)).mT
_PRODUCTS: Final = _MATRICES[:, None] @ _MATRICES.mT[None]
RELATIVE: Final = (_PRODUCTS[:, :, None] == _MATRICES).all(axis=(-1, -2)).argmax(axis=-1)


def from_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) back from the frame of an octant."""
    return to_octant_image(int(RELATIVE[0, octant]), image)


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
    k = np.arange(DIRECTIONS)
    if octant & 1:
        k = (8 - k) % DIRECTIONS
    if octant & 2:
        k = -k % DIRECTIONS
    if octant & 4:
        k = (4 - k) % DIRECTIONS
    found = np.argsort(k)[:_HALF]
    place, sign = found % _HALF, np.where(found < _HALF, 1.0, -1.0)
    index, signs = np.arange(LENGTH), np.ones(LENGTH, np.float32)
    turned = group("level").start
    index[:turned] = (np.arange(0, turned, _HALF)[:, None] + place).ravel()
    for name in ("cubed_odd", "seventh_odd"):
        signs[group(name)] = np.tile(sign, len(_SHIFTS))
    return index, signs


# --- the network ---------------------------------------------------------------------------------

FAR_M: Final = 50.0  # focus farther away is as good as infinite: a lens of 300 mm moves less than 2 mm for it
_GREEN_UM: Final = 0.54
SETTINGS: Final = 5  # columns: logarithms of f-number, diffraction width (px), focal length, focus; the kind


def conditions_of(
    settings: LensSettings, pitch_um: float | None, kind: PatchKind = "raw"
) -> NDArray[np.float64]:
    """What is known of how a patch was taken, or of what is asked for, (SETTINGS,); unknown is NaN.

    `kind`: samples of the mosaic, developed planes, or those of a camera; infinite focus is that of `FAR_M`.
    """
    given = (settings.aperture, pitch_um, settings.focal_mm, settings.focus_m)
    f_number, pitch, focal, focus = (math.nan if value is None else value for value in given)
    values = (f_number, _GREEN_UM * f_number / pitch, focal, min(focus, FAR_M))
    return np.array([*map(math.log, values), float(KINDS.index(kind))])


def place_features(xy: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features of places, (..., 2) to (..., PLACE), the same for all eight that symmetry joins."""
    canonical = to_octant_place(octant_of(xy), xy)
    x, y = canonical[..., 0], canonical[..., 1]
    r = np.hypot(x, y)
    angle = np.arctan2(y, np.maximum(x, 1e-9))
    parts = [x, y, r, r * r, r**3, np.cos(4 * angle), np.sin(4 * angle), r * np.cos(4 * angle)]
    for k in (1.5, 3.0):
        parts += [np.sin(k * x), np.cos(k * x), np.sin(k * y), np.cos(k * y), np.cos(2 * k * r)]
    return np.stack(parts, -1).astype(np.float32)


PLACE: Final = 18


def condition_features(settings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features of settings, shape (..., SETTINGS) to (..., CONDITION)."""
    known = np.isfinite(settings[..., :2])
    values = np.where(known, settings[..., :2], 0.0)
    kinds = settings[..., 4:5] == np.arange(len(KINDS))
    return np.concatenate([values, known, kinds], -1).astype(np.float32)


CONDITION: Final = 7


def relation_features(
    query_xy: NDArray[np.floating],
    query_settings: NDArray[np.floating],
    sample_xy: NDArray[np.floating],
    sample_settings: NDArray[np.floating],
) -> NDArray[np.float32]:
    """How each sample lies to each query, as float32 of shape (..., q, n, RELATION).

    Of places (..., q, 2) and settings (..., q, SETTINGS) of queries and samples. The first `DISTANCES` are
    squared distances: in the plane, along the radius, in log f-number, focal length and focus.
    """
    octants = octant_of(query_xy)
    at = to_octant_place(octants, query_xy)[..., :, None, :]
    place = to_octant_place(octants[..., :, None], sample_xy[..., None, :, :])
    offset = place - at
    squared = np.square(offset).sum(-1)
    radius = np.hypot(place[..., 0], place[..., 1])
    along = radius - np.hypot(at[..., 0], at[..., 1])
    change = sample_settings[..., None, :, :] - query_settings[..., :, None, :]
    known = np.isfinite(change[..., :4])
    change = np.where(known, change[..., :4], 0.0)
    same_kind = (sample_settings[..., None, :, 4] == query_settings[..., :, None, 4]).astype(float)
    turn = RELATIVE[octants[..., :, None], octant_of(sample_xy)[..., None, :]]
    parts = [
        squared, along**2, change[..., 0] ** 2, change[..., 2] ** 2, change[..., 3] ** 2,
        offset[..., 0], offset[..., 1], place[..., 0], place[..., 1], radius, along,
        np.exp(-squared / 0.05), np.exp(-squared / 0.3), np.exp(-(along**2) / 0.02),
        change[..., 0], change[..., 1], change[..., 2], change[..., 3],
        known[..., 0].astype(float), known[..., 1].astype(float), same_kind,
    ]  # fmt: skip
    one_hot = turn[..., None] == np.arange(OCTANTS)
    return np.concatenate([np.stack(parts, -1), one_hot], -1).astype(np.float32)


DISTANCES: Final = 5
RELATION: Final = 21 + OCTANTS


Array = NDArray[np.float32]

FINE: Final = 33  # pixels: side of the part of a kernel that is told pixel by pixel
COARSE: Final = 25
BLOCK: Final = 3
SIDE: Final = COARSE * BLOCK  # of a kernel, told in cells of BLOCK x BLOCK pixels beyond the fine part
RINGS: Final = 8  # of frequency, 1/16 cycles/pixel wide, for which an error of the transfer function is told
RING_MIDDLES: Final = (np.arange(RINGS) + 0.5) / (2 * RINGS)  # cycles/pixel

WEIGHTS: Final = Path(__file__).parent / "data" / "weights.npz"  # the weights of the package
_CLAMP: Final = 6.0  # standard deviations that a statistic may lie off the population's mean
_LAYER_EPSILON: Final = 1e-5


def outer_cells() -> NDArray[np.bool_]:
    """Cells of the coarse grid that lie outside the fine part, shape (COARSE, COARSE)."""
    edge = (COARSE - FINE // BLOCK) // 2
    outer = np.ones((COARSE, COARSE), bool)
    outer[edge:-edge, edge:-edge] = False
    return outer


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Samples as the queries see them: places, settings, and keys and values of each attention."""

    xy: NDArray[np.float64]  # (n, 2)
    settings: NDArray[np.float64]  # (n, SETTINGS)
    keys: Array  # (blocks, heads, n, width)
    values: Array


@dataclass(frozen=True, slots=True, eq=False)
class FieldAnswer:
    """The PSF at a place and settings."""

    kernels: NDArray[np.float64]  # (3, SIDE, SIDE), of red, green and blue; of sum 1, centred
    error: NDArray[np.float64]  # (3,), expected relative L2 distance to the true kernels
    ring_error: NDArray[np.float64]  # (3, RINGS), expected r.m.s. error of the transfer function
    weights: NDArray[np.float64]  # (n,), of the samples, of sum 1: the mean over all attention


def _gelu(x: Array) -> Array:
    return (0.5 * x * (1.0 + erf(x / np.float32(np.sqrt(2.0))))).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class FieldNetwork:
    """Encoder and decoder with their weights; see the module."""

    weights: Mapping[str, Array]
    provenance: Mapping[str, Any]  # of the weights: code, seeds, population, figures
    name: str  # fingerprint of the weights

    @classmethod
    @cache
    def load(cls) -> FieldNetwork:
        """Return the network with the weights of the package; read once a process."""
        return cls.from_bytes(WEIGHTS.read_bytes())

    @classmethod
    def from_bytes(cls, data: bytes) -> FieldNetwork:
        """Read weights: npz of float16 with a JSON text of their provenance, as `lab.population` writes."""
        with np.load(BytesIO(data)) as stored:
            provenance = json.loads(bytes(stored["provenance"]).decode())
            weights = {n: stored[n].astype(np.float32) for n in stored.files if n != "provenance"}
        if weights["mean"].shape != (LENGTH,):
            raise InvalidInputError(
                f"weights are of {weights['mean'].size} statistics, not {LENGTH}; train anew"
            )
        return cls(weights, provenance, sha256(data).hexdigest()[:12])

    def _linear(self, name: str, x: Array) -> Array:
        return x @ self.weights[name + ".weight"].T + self.weights[name + ".bias"]

    def _normal(self, name: str, x: Array) -> Array:
        centred = x - x.mean(-1, keepdims=True)
        scale = np.sqrt(np.square(centred).mean(-1, keepdims=True) + np.float32(_LAYER_EPSILON))
        return centred / scale * self.weights[name + ".weight"] + self.weights[name + ".bias"]

    def _heads(self, x: Array) -> Array:
        """(n, heads * width) to (heads, n, width)."""
        heads = len(self.weights["decoder.0.nothing"])
        return x.reshape(len(x), heads, -1).transpose(1, 0, 2)

    def _keys(self, block: str, tokens: Array) -> tuple[Array, Array]:
        both = self._linear(f"{block}.kv", self._normal(f"{block}.normal_memory", tokens))
        key, value = np.split(both, 2, axis=-1)
        return self._heads(key), self._heads(value)

    def _block(self, block: str, x: Array, key: Array, value: Array, relation: Array) -> tuple[Array, Array]:
        """Attention of x (q, d) to keys and values (heads, n, width), then two layers; and the attention."""
        w = self.weights
        query = self._heads(self._linear(f"{block}.q", self._normal(f"{block}.normal_query", x)))
        score = query @ key.transpose(0, 2, 1) / np.float32(np.sqrt(query.shape[-1]))
        directed = (query @ w[f"{block}.relation_key"]).transpose(1, 0, 2)  # (q, heads, RELATION)
        near = relation[..., :DISTANCES] @ np.abs(w[f"{block}.distance"])  # (q, n, heads)
        score += (directed @ relation.transpose(0, 2, 1) - near.transpose(0, 2, 1)).transpose(1, 0, 2)
        nothing = np.broadcast_to(w[f"{block}.nothing"][:, None, None], (*score.shape[:2], 1))
        attention = softmax(np.concatenate([score, nothing], -1), axis=-1)[..., :-1]
        seen = (attention.transpose(1, 0, 2) @ relation).transpose(1, 0, 2)  # (heads, q, RELATION)
        taken = (attention @ value + seen @ w[f"{block}.relation_value"]).astype(np.float32)
        x = x + self._linear(f"{block}.out", taken.transpose(1, 0, 2).reshape(len(x), -1))
        inner = _gelu(self._linear(f"{block}.inner", self._normal(f"{block}.normal_inner", x)))
        return x + self._linear(f"{block}.outer", inner), attention

    def _blocks(self, part: str) -> list[str]:
        return sorted({".".join(name.split(".")[:2]) for name in self.weights if name.startswith(part + ".")})

    def encode(
        self, statistics: NDArray[np.floating], xy: NDArray[np.floating], conditions: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Tokens (n, d) of the patches of one photo, whose order does not matter to any of them.

        `statistics` (n, LENGTH) are those of `patch_statistics`, turned by `to_octant`; `xy` (n, 2) places in
        half diagonals, x to the right, y upwards.
        """
        statistics, xy = np.asarray(statistics, np.float32), np.asarray(xy, np.float64)
        if statistics.ndim != 2 or statistics.shape[1] != LENGTH or xy.shape != (len(statistics), 2):
            raise InvalidInputError(
                f"statistics must be (n, {LENGTH}) and places (n, 2), got {statistics.shape} and {xy.shape}"
            )
        if not (np.isfinite(statistics).all() and np.isfinite(xy).all()):
            raise InvalidInputError("statistics and places must be finite; leave patches out that are not")
        rows = np.broadcast_to(conditions, (len(xy), SETTINGS))
        x = np.clip((statistics - self.weights["mean"]) / self.weights["spread"], -_CLAMP, _CLAMP)
        x = np.concatenate([x, condition_features(rows), place_features(xy)], -1)
        t = _gelu(self._linear("enter", x))
        t = t + self._linear("widen.1", _gelu(self._linear("widen.0", self._normal("widen.normal", t))))
        t = self._linear("narrow", self._normal("narrow.normal", t))
        relation = relation_features(xy, rows, xy, rows)
        for block in self._blocks("encoder"):
            t, _ = self._block(block, t, *self._keys(block, t), relation)
        return t

    def memory(
        self, tokens: NDArray[np.floating], xy: NDArray[np.floating], conditions: NDArray[np.float64]
    ) -> Memory:
        """Keys and values of samples (n, d) of any photos; `conditions` are of each, or of all."""
        tokens = np.asarray(tokens, np.float32)
        pairs = [self._keys(block, tokens) for block in self._blocks("decoder")]
        keys, values = (np.stack(parts) for parts in zip(*pairs, strict=True))
        rows = np.broadcast_to(conditions, (len(xy), SETTINGS))
        return Memory(np.asarray(xy, np.float64), rows, keys, values)

    def query(self, memory: Memory, xy: NDArray[np.floating], conditions: NDArray[np.float64]) -> FieldAnswer:
        """Answer at a place, shape (2,) in half diagonals, x to the right, y upwards, as it is asked for."""
        place, rows = np.asarray(xy, np.float64)[None], conditions[None]
        x = np.concatenate([place_features(place), condition_features(rows)], -1)
        x = self._linear("ask.1", _gelu(self._linear("ask.0", x)))
        relation = relation_features(place, rows, memory.xy, memory.settings)
        weights = np.zeros(len(memory.xy))
        for i, block in enumerate(self._blocks("decoder")):
            x, attention = self._block(block, x, memory.keys[i], memory.values[i], relation)
            weights += attention[:, 0].sum(0)
        hidden = _gelu(self._linear("kernel.0", self._normal("kernel.normal", x)))
        logits = self._linear("kernel.2", self._linear("kernel.1", hidden)).reshape(3, -1)
        told = self._linear("error.1", _gelu(self._linear("error.0", self._normal("error.normal", x))))[0]
        kernels = from_octant_image(int(octant_of(place)[0]), assembled(softmax(logits, axis=-1)))
        return FieldAnswer(
            centred_kernels(kernels),
            np.exp(told[:3]).astype(np.float64),
            np.exp(told[3:]).reshape(3, RINGS).astype(np.float64),
            weights / max(weights.sum(), 1e-30),
        )


def assembled(parts: NDArray[np.floating]) -> NDArray[np.float64]:
    """Kernels (..., SIDE, SIDE) of shares (..., FINE^2 + outer cells); cells are smoothed at borders."""
    parts = np.asarray(parts, np.float64)
    lead = parts.shape[:-1]
    coarse = np.zeros((*lead, COARSE, COARSE))
    coarse[..., outer_cells()] = parts[..., FINE * FINE :]
    total = coarse.sum((-1, -2))
    wide = np.repeat(np.repeat(coarse, BLOCK, -2), BLOCK, -1)
    for axis in (-2, -1):
        wide = wide + np.roll(wide, 1, axis) + np.roll(wide, -1, axis)
    margin = (SIDE - FINE) // 2
    inner = slice(margin, SIDE - margin)
    wide[..., inner, inner] = 0.0
    rest = wide.sum((-1, -2))
    wide *= (total / np.maximum(rest, 1e-30))[..., None, None]
    wide[..., inner, inner] = parts[..., : FINE * FINE].reshape(*lead, FINE, FINE)
    whole: NDArray[np.float64] = wide / wide.sum((-1, -2), keepdims=True)
    return whole


def centred_kernels(kernels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Kernels (..., n, n) moved by the part of a pixel that their centre of mass is off the middle."""
    moving: NDArray[np.float64] = np.asarray(kernels, np.float64)
    at = np.arange(moving.shape[-1]) - moving.shape[-1] // 2
    for axis, other in ((-1, -2), (-2, -1)):
        shift = -(moving.sum(other) @ at)[..., None, None]
        moved = np.where(shift > 0, np.roll(moving, 1, axis), np.roll(moving, -1, axis))
        part = np.clip(np.abs(shift), 0.0, 1.0)
        moving = (1 - part) * moving + part * moved
    return moving
