"""How much power of a scene a wavefront lets through, in the bins of a patch's spectrum.

The transfer function is the autocorrelation of the pupil P = A exp(2 pi i W)::

    OTF(f) = sum_p P(p + q f) P*(p - q f) / sum_p |P(p)|^2,      q = wavelength x f-number / pixel pitch

With the wavefront in blur (see `pupil`), 2 pi W = (pi / q) sum_k g_k B_k, the phase of a term is
sum_k g_k (pi / q) (B_k(p + q f) - B_k(p - q f)): smooth in p however small q is, so that a coarse
pupil does. A kernel is known on pixels only, the centre of its light at the middle of one::

    K(f) = sum_k sinc(f + k) OTF(f + k) exp(-2 pi i k . d),      d = centre of the light, k whole

The square of its modulus is averaged over each bin, since the zeros of an OTF are lines; where it is
smooth, one frequency stands for the bin.

Source: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, eq. 6-27.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.loops import compiled
from lensmodel.core.spectrum import (
    FIRST_PHASE_RING,
    PHASE_BINS,
    RING_EDGES,
    RINGS,
    SECTORS,
    bin_frequencies,
)
from lensmodel.optics.pupil import ray_gradients

FIRST_RING: Final = FIRST_PHASE_RING
"""Rings below hold too few frequencies of a 64 px tile to be told apart by angle."""

BINS: Final = (RINGS - FIRST_RING) * SECTORS
"""Number of bins that count."""

_ACROSS, _ACROSS_COARSE = 26, 16  # samples across the pupil: the cost goes with their square (chosen)

COLUMNS: Final = 20
"""Real and imaginary sum, the latter two by six terms, and by three numbers of the cat's eye."""

_RATIO = float(RING_EDGES[1] / RING_EDGES[0])
_INSIDE = (-0.3, 0.3)  # where a bin is sampled, in parts of its width: near Gauss's two points, 0.29
_SMOOTH = 5  # rings in which one sample does: nothing has zeros at such low frequencies (chosen)
_HIGHEST = 0.75  # cycles/pixel; beyond, lens and pixel pass too little to count (chosen)
_LEAST = 1e-7  # |OTF|^2 at least: keeps its logarithm finite where the lens passes nothing

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Waves = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """The pupil laid out for one q.

    Parameters
    ----------
    q : float
        Wavelength x f-number / pixel pitch.
    points : tuple of ndarray of float32, shape (P,)
        The pupil p, (right, up).
    shifts : tuple of ndarray of float32, shape (F,)
        q (f + k) of the aliases of all frequencies, those of one frequency side by side.
    steep : float
        Slope of the edge of a stop, which is one sample wide.
    pixel : ndarray, shape (F,)
        sinc(f + k).
    aliases : ndarray, shape (F, 2)
        k, (right, up).
    first : ndarray of int, shape (S,)
        Where the aliases of each of S frequencies begin.
    share : ndarray, shape (S,)
        One over the number of frequencies of the bin, which are one or four.
    bins : ndarray of int, shape (S,)
        Which bin each frequency belongs to.
    """

    q: float
    points: tuple[Singles, Singles]
    shifts: tuple[Singles, Singles]
    steep: float
    pixel: Floats
    aliases: Floats
    first: NDArray[np.intp]
    share: Floats
    bins: NDArray[np.intp]

    @classmethod
    def of(cls, q: float, rings: int = RINGS - FIRST_RING, *, coarse: bool = False) -> Transfer:
        """Lay out the pupil; layouts are remembered.

        Parameters
        ----------
        q : float
            Wavelength x f-number / pixel pitch.
        rings : int
            How many of the innermost rings that count; bins beyond pass nothing.
        coarse : bool
            Fewer samples and one frequency to a bin: a seventh of the sums, for searching.
        """
        return _laid_out(round(q, 4), rings, coarse)

    def log_power(
        self, blur: Floats, radius: float, shift: tuple[float, float]
    ) -> tuple[Floats, Floats, Floats]:
        """Logarithm of the mean square of the transfer function in each bin, and its derivatives.

        Parameters
        ----------
        blur : ndarray, shape (6,)
            Coefficients of the first six terms of `pupil`, pixels.
        radius : float
            Of the second circle of the pupil (cat's eye), in units of the stop.
        shift : tuple of float
            Its middle, (right, up).

        Returns
        -------
        value : ndarray, shape (BINS,)
        by_blur : ndarray, shape (BINS, 6)
        by_eye : ndarray, shape (BINS, 3)
            By `radius` and `shift`.
        """
        return self.log_power_of(self.waves(blur, radius, shift))

    def log_power_of(self, kernel: Waves) -> tuple[Floats, Floats, Floats]:
        """Return `log_power` of what `waves` gave, complex128 of shape (S, 10)."""
        # |K|^2 and its derivatives 2 Re K* dK
        products = (kernel[:, :1].conj() * kernel).real * self.share[:, None]
        products[:, 1:] *= 2.0
        power = np.stack([np.bincount(self.bins, column, BINS) for column in products.T], axis=1)
        safe = np.clip(power[:, 0], _LEAST, 1.0)
        relative = power[:, 1:] / safe[:, None]
        return np.log(safe), relative[:, :6], relative[:, 6:]

    def waves(self, blur: Floats, radius: float, shift: tuple[float, float]) -> Waves:
        """K at the S frequencies, and its derivatives by `blur`, `radius` and `shift`, shape (S, 10).

        Parameters are those of `log_power`.
        """
        otf, otf_by_blur, otf_by_eye = self._optical(blur, radius, shift)
        centre, centre_by_blur, centre_by_eye = self._centre(blur, radius, shift)
        turn = self.pixel * np.exp(-2j * math.pi * (self.aliases @ centre))
        moved = -2j * math.pi * self.aliases * otf[:, None]
        by = [otf[:, None], otf_by_blur + moved @ centre_by_blur, otf_by_eye + moved @ centre_by_eye]
        columns = np.concatenate(by, axis=1) * turn[:, None]
        return cast("Waves", np.add.reduceat(columns, self.first, axis=0))

    def _optical(self, blur: Floats, radius: float, shift: tuple[float, float]) -> tuple[Waves, Waves, Waves]:
        """OTF of the lens alone at f + k, shape (F,), and its derivatives (F, 6), (F, 3)."""
        open_, alone, alone_by = self._stops(radius, shift)
        area = float((open_ * alone * open_ * alone).sum())
        turns = (blur / (2.0 * self.q)).astype(np.float32)
        eye = np.array([radius, *shift], dtype=np.float32)
        out = np.zeros((self.pixel.size, COLUMNS), dtype=np.float32)
        _engine()(*self.points, *self.shifts, turns, eye, np.float32(self.steep), out)
        sums = out.astype(np.float64) / area
        otf: Waves = sums[:, 0] + 1j * sums[:, 1]
        by_blur: Waves = (sums[:, 2:8] + 1j * sums[:, 8:14]) * complex(math.pi / self.q)
        loss = [2.0 * float((open_ * open_ * alone * own).sum()) / area for own in alone_by]
        by_eye: Waves = sums[:, 14:17] + 1j * sums[:, 17:20] - otf[:, None] * np.array(loss)
        return otf, by_blur, by_eye

    def _centre(
        self, blur: Floats, radius: float, shift: tuple[float, float]
    ) -> tuple[Floats, Floats, Floats]:
        """Centre of the light (right, up), pixels, and its derivatives (2, 6), (2, 3)."""
        px, py = (point.astype(np.float64) for point in self.points)
        open_, alone, alone_by = self._stops(radius, shift)
        weight = (open_ * alone).astype(np.float64) ** 2
        rays = np.array(ray_gradients(px, py))
        by_blur = rays @ weight / weight.sum()
        centre = by_blur @ blur
        landed = np.einsum("akp,k->ap", rays, blur) - centre[:, None]
        change = np.stack([2.0 * open_ * open_ * alone * own for own in alone_by])
        return centre, by_blur, landed @ change.T / weight.sum()

    def _stops(
        self, radius: float, shift: tuple[float, float]
    ) -> tuple[Singles, Singles, tuple[Singles, ...]]:
        """Transmission of the stop, and of the second circle with its derivatives."""
        open_ = _circle(*self.points, 1.0, (0.0, 0.0), self.steep)[0]
        return open_, *_circle(*self.points, radius, shift, self.steep)


def phase_between(
    channel: Transfer, of_channel: Waves, green: Transfer, of_green: Waves
) -> tuple[Floats, Floats, Floats]:
    """Phase of a channel's image against that of green in the innermost bins, and its derivatives.

    Parameters
    ----------
    channel, green : Transfer
        Of `PHASE_RINGS` rings at least.
    of_channel, of_green : ndarray, shape (S, 10)
        What their `waves` gave.

    Returns
    -------
    phase : ndarray, shape (PHASE_BINS,)
        Radians; that of the sum of conj(K_C) K_G over the frequencies of a bin, since K is the conjugate of
        what `numpy.fft` makes of a kernel.
    by_channel, by_green : ndarray, shape (PHASE_BINS, 9)
        By what the columns of `of_channel` and of `of_green` are derived by.
    """
    bins = green.bins[green.bins < PHASE_BINS]
    first, second = (waves[of.bins < PHASE_BINS] for of, waves in ((channel, of_channel), (green, of_green)))

    def summed(values: Waves) -> Waves:
        real, imaginary = (
            np.stack([np.bincount(bins, column, PHASE_BINS) for column in part.T], axis=1)
            for part in (values.real, values.imag)
        )
        return cast("Waves", real + 1j * imaginary)

    by_channel, by_green = summed(first.conj() * second[:, :1]), summed(first[:, :1].conj() * second)
    both = by_channel[:, :1]
    safe = np.where(np.abs(both) > _LEAST, both, _LEAST)
    return np.angle(both[:, 0]), (by_channel[:, 1:] / safe).imag, (by_green[:, 1:] / safe).imag


@lru_cache(maxsize=32)
def _laid_out(q: float, rings: int, coarse: bool) -> Transfer:
    modulus, angle = bin_frequencies()
    ring = np.arange(BINS) // SECTORS
    alone = ring < (rings if coarse else _SMOOTH)
    single, several = np.flatnonzero(alone), np.flatnonzero(~alone & (ring < rings))
    along, across = (a.ravel()[:, None] for a in np.meshgrid(_INSIDE, _INSIDE))
    f = np.concatenate([modulus[single], (modulus[several] * _RATIO**along).ravel()])
    t = np.concatenate([angle[single], (angle[several] + across * math.pi / SECTORS).ravel()])
    bins = np.concatenate([single, np.tile(several, len(_INSIDE) ** 2)])
    share = np.where(alone[bins], 1.0, 1.0 / len(_INSIDE) ** 2)
    pixel, aliases, first = _aliases(f * np.cos(t), -f * np.sin(t))  # rows grow downwards
    number = np.repeat(np.arange(f.size), np.diff([*first, len(pixel)]))
    fx, fy = (f * np.cos(t))[number] + aliases[:, 0], (-f * np.sin(t))[number] + aliases[:, 1]
    samples = _ACROSS_COARSE if coarse else _ACROSS
    side = (np.arange(samples) - (samples - 1) / 2.0) * 2.0 / samples
    px, py = (a.ravel() for a in np.meshgrid(side, side))
    inside = np.hypot(px, py) <= 1.0 + 1.0 / samples
    return Transfer(
        q,
        (px[inside].astype(np.float32), py[inside].astype(np.float32)),
        ((q * fx).astype(np.float32), (q * fy).astype(np.float32)),
        samples / 2.0,
        pixel,
        aliases,
        first,
        share,
        bins,
    )


def _engine() -> Callable[..., None]:
    """Return the compiled loop where Numba is installed."""
    module = compiled("lensmodel.optics.compiled_transfer")
    return sums if module is None else cast("Callable[..., None]", module.sums)


def sums(
    px: Singles,
    py: Singles,
    fx: Singles,
    fy: Singles,
    turns: Singles,
    eye: Singles,
    steep: float,
    out: Singles,
) -> None:
    """Sum over the pupil, without Numba: `compiled_transfer.sums`, where the columns of `out` are told."""
    ax, ay = px + fx[:, None], py + fy[:, None]
    bx, by = px - fx[:, None], py - fy[:, None]
    stop = _circle(ax, ay, 1.0, (0.0, 0.0), steep)[0] * _circle(bx, by, 1.0, (0.0, 0.0), steep)[0]
    radius, shift = float(eye[0]), (float(eye[1]), float(eye[2]))
    ahead, ahead_by = _circle(ax, ay, radius, shift, steep)
    behind, behind_by = _circle(bx, by, radius, shift, steep)
    phases = _terms(ax, ay) - _terms(bx, by)
    angle = np.tensordot(turns * np.float32(2.0 * math.pi), phases, axes=1)
    cosine, sine = np.cos(angle), np.sin(angle)
    both = stop * ahead * behind
    real, imaginary = both * cosine, both * sine
    out[:, 0], out[:, 1] = real.sum(axis=1), imaginary.sum(axis=1)
    out[:, 2:8] = -np.einsum("kfp,fp->fk", phases, imaginary)
    out[:, 8:14] = np.einsum("kfp,fp->fk", phases, real)
    for j, (one, other) in enumerate(zip(ahead_by, behind_by, strict=True)):
        change = stop * (one * behind + ahead * other)
        out[:, 14 + j] = np.einsum("fp,fp->f", change, cosine)
        out[:, 17 + j] = np.einsum("fp,fp->f", change, sine)


def _terms(px: Singles, py: Singles) -> Singles:
    """Return the first six terms of `pupil`."""
    rho2 = px * px + py * py
    return np.stack([rho2 * rho2, px * rho2, py * rho2, rho2, px * px - py * py, 2.0 * px * py])


def _circle(
    px: Singles, py: Singles, radius: float, shift: tuple[float, float], steep: float
) -> tuple[Singles, tuple[Singles, ...]]:
    """Transmission of a disc with a soft edge; derivatives by radius and shift.

    Squares spare the root: (radius^2 - r^2) / (2 radius) is the distance to the edge near it.
    """
    single = np.float32
    dx, dy = px - single(shift[0]), py - single(shift[1])
    edge = (single(radius * radius) - dx * dx - dy * dy) * single(steep / (2.0 * radius)) + single(0.5)
    inside = np.clip(edge, 0.0, 1.0)
    soft = ((edge > 0.0) & (edge < 1.0)) * single(steep)
    over = single(1.0 / radius)
    return inside, (soft, soft * dx * over, soft * dy * over)


def _aliases(fx: Floats, fy: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Sinc and whole numbers k of the aliases that pass a lens, and where those of each f begin."""
    moves = np.array([(i, j) for i in (0, -1, 1) for j in (0, -1, 1)], dtype=np.float64)
    x, y = fx[:, None] + moves[:, 0], fy[:, None] + moves[:, 1]
    kept = (np.hypot(x, y) < _HIGHEST) | (moves == 0.0).all(axis=1)
    first = np.concatenate([[0], np.cumsum(kept.sum(axis=1))[:-1]])
    return (np.sinc(x) * np.sinc(y))[kept], moves[np.nonzero(kept)[1]], first.astype(np.intp)
