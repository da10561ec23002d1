"""How much power of a scene a wavefront lets through, in the bins of a patch's spectrum.

The transfer function is the autocorrelation of the pupil P = A exp(2 pi i W)::

    OTF(f) = sum_p P(p + q f) P*(p - q f) / sum_p |P(p)|^2,      q = wavelength x f-number / pixel pitch

With the wavefront in blur (see `pupil`), 2 pi W = (pi / q) sum_k g_k B_k, the phase of a term is
sum_k g_k (pi / q) (B_k(p + q f) - B_k(p - q f)): smooth in p however small q is, so that a coarse
pupil does. The square of its modulus is averaged over each bin, since the
zeros of an OTF are lines; where it is smooth, one frequency stands for the bin. A kernel is known on pixels
only, so that its spectrum is a sum over aliases: sharp lenses lose no contrast to the pixel that the kernel,
as we define it, could show.

Source: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, eq. 6-27.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.spectrum import RING_LIMITS, RINGS, SECTORS

FIRST_RING: Final = 3
"""Rings below hold too few frequencies of a 64 px tile to be told apart by angle."""

BINS: Final = (RINGS - FIRST_RING) * SECTORS
"""Number of bins that count."""

_ACROSS = 26  # samples across the pupil
_EDGE = np.geomspace(*RING_LIMITS, RINGS + 1)
_RATIO = float(_EDGE[1] / _EDGE[0])
_INSIDE = (-0.3, 0.3)  # where a bin is sampled, in parts of its width
_SMOOTH = 5  # rings in which one sample does: nothing has zeros at such low frequencies
BORROWED_RINGS: Final = 3
"""Outermost rings that say nothing of red and blue: demosaicing takes them from green."""
_LEAST = 1e-7

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


def bin_frequencies() -> tuple[Floats, Floats]:
    """Modulus (cycles/pixel) and angle of the middle of each bin, shape (BINS,) each.

    The angle is that of `spectrum.binned_spectrum`: from the columns' axis towards the rows'.
    """
    middle = np.sqrt(_EDGE[1:] * _EDGE[:-1])[FIRST_RING:]
    angle = (np.arange(SECTORS) + 0.5) * math.pi / SECTORS
    modulus, turned = np.meshgrid(middle, angle, indexing="ij")
    return modulus.ravel(), turned.ravel()


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """The pupil laid out for one q.

    Parameters
    ----------
    ahead, behind : tuple of ndarray, shape (F, P)
        Coordinates (right, up) of p + q f and p - q f; F frequencies, one or four to a bin.
    phases : ndarray, shape (6, F, P)
        Phase per pixel of blur of each term of `pupil` but the tilts.
    stop : ndarray, shape (F, P)
        Transmission of the two shifted stops.
    points : tuple of ndarray, shape (P,)
        The pupil p itself.
    share : ndarray, shape (F,)
        One over the number of frequencies of the bin.
    bins : ndarray of int, shape (F,)
        Which bin each frequency belongs to.
    """

    ahead: tuple[Singles, Singles]
    behind: tuple[Singles, Singles]
    phases: Singles
    stop: Singles
    points: tuple[Singles, Singles]
    share: Floats
    bins: NDArray[np.intp]

    @classmethod
    def of(cls, q: float, rings: int = RINGS - FIRST_RING) -> Transfer:
        """Lay out the pupil for the innermost `rings` that count; layouts are remembered."""
        return _laid_out(round(q, 4), rings)

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
        power, by_blur, by_eye = self._optical(blur, radius, shift)
        safe = np.clip(power, _LEAST, 1.0)
        value, slope = _on_pixels(safe)
        scale = (slope / safe)[:, None]
        return value, by_blur * scale, by_eye * scale

    def _optical(
        self, blur: Floats, radius: float, shift: tuple[float, float]
    ) -> tuple[Floats, Floats, Floats]:
        """Mean square of the transfer function of the lens alone in each bin, and its derivatives."""
        ahead, ahead_by = _circle(*self.ahead, radius, shift)
        behind, behind_by = _circle(*self.behind, radius, shift)
        alone, alone_by = _circle(*self.points, radius, shift)
        open_ = _circle(*self.points, 1.0, (0.0, 0.0))[0]
        area = float((open_ * alone * open_ * alone).sum())
        angle = np.tensordot(blur.astype(np.float32), self.phases, axes=1)
        cosine, sine = np.cos(angle), np.sin(angle)
        both = self.stop * ahead * behind
        real_parts, imaginary_parts = both * cosine, both * sine
        real, imaginary = (
            real_parts.sum(axis=1, dtype=np.float64),
            imaginary_parts.sum(axis=1, dtype=np.float64),
        )
        scale = self.share / area**2
        power = self._binned((real * real + imaginary * imaginary) * scale)
        found = []
        for phase in self.phases:
            by_real = -np.einsum("fp,fp->f", phase, imaginary_parts)
            by_imaginary = np.einsum("fp,fp->f", phase, real_parts)
            found.append(self._binned(2.0 * scale * (real * by_real + imaginary * by_imaginary)))
        eye = []
        for one, other, own in zip(ahead_by, behind_by, alone_by, strict=True):
            change = self.stop * (one * behind + ahead * other)
            towards = real * np.einsum("fp,fp->f", change, cosine)
            towards += imaginary * np.einsum("fp,fp->f", change, sine)
            loss = 4.0 * float((open_ * open_ * alone * own).sum()) / area
            eye.append(self._binned(2.0 * scale * towards) - power * loss)
        return power, np.stack(found, axis=1), np.stack(eye, axis=1)

    def _binned(self, values: Floats) -> Floats:
        return np.asarray(np.bincount(self.bins, values, BINS), dtype=np.float64)


@lru_cache(maxsize=16)
def _laid_out(q: float, rings: int) -> Transfer:
    modulus, angle = bin_frequencies()
    ring = np.arange(BINS) // SECTORS
    smooth, rough = np.flatnonzero(ring < _SMOOTH), np.flatnonzero((ring >= _SMOOTH) & (ring < rings))
    along, across = (a.ravel()[:, None] for a in np.meshgrid(_INSIDE, _INSIDE))
    f = np.concatenate([modulus[smooth], (modulus[rough] * _RATIO**along).ravel()])
    t = np.concatenate([angle[smooth], (angle[rough] + across * math.pi / SECTORS).ravel()])
    bins = np.concatenate([smooth, np.tile(rough, len(_INSIDE) ** 2)])
    share = np.where(bins < smooth.size, 1.0, 1.0 / len(_INSIDE) ** 2)
    fx, fy = f * np.cos(t), -f * np.sin(t)  # rows grow downwards
    side = ((np.arange(_ACROSS) - (_ACROSS - 1) / 2.0) * 2.0 / _ACROSS).astype(np.float64)
    px, py = (a.ravel() for a in np.meshgrid(side, side))
    inside = np.hypot(px, py) <= 1.0 + 1.0 / _ACROSS
    px, py = px[inside], py[inside]
    ahead = (px + q * fx[:, None], py + q * fy[:, None])
    behind = (px - q * fx[:, None], py - q * fy[:, None])
    stop = _circle(*ahead, 1.0, (0.0, 0.0))[0] * _circle(*behind, 1.0, (0.0, 0.0))[0]
    phases = (_terms(*ahead) - _terms(*behind)) * (math.pi / q)
    return Transfer(
        (ahead[0].astype(np.float32), ahead[1].astype(np.float32)),
        (behind[0].astype(np.float32), behind[1].astype(np.float32)),
        phases.astype(np.float32),
        stop.astype(np.float32),
        (px.astype(np.float32), py.astype(np.float32)),
        share,
        bins,
    )


def _terms(px: Floats, py: Floats) -> Floats:
    """Return the first six terms of `pupil`."""
    rho2 = px * px + py * py
    return np.stack([rho2 * rho2, px * rho2, py * rho2, rho2, px * px - py * py, 2.0 * px * py])


def _circle(
    px: NDArray[np.floating], py: NDArray[np.floating], radius: float, shift: tuple[float, float]
) -> tuple[NDArray[np.floating], tuple[NDArray[np.floating], ...]]:
    """Transmission of a disc whose edge is one sample wide; derivatives by radius and shift.

    Squares spare the root: (radius^2 - r^2) / (2 radius) is the distance to the edge near it.
    """
    dtype = px.dtype.type
    dx, dy = px - dtype(shift[0]), py - dtype(shift[1])
    steep = dtype(_ACROSS / 2.0)
    edge = (dtype(radius * radius) - dx * dx - dy * dy) * (steep / dtype(2.0 * radius)) + dtype(0.5)
    inside = np.clip(edge, 0.0, 1.0)
    soft = ((edge > 0.0) & (edge < 1.0)) * steep
    over = dtype(1.0 / radius)
    return inside, (soft, soft * dx * over, soft * dy * over)


def _on_pixels(power: Floats) -> tuple[Floats, Floats]:
    """Ln |K|^2 of the kernel on pixels, and its derivative by the logarithm of the lens's `power`.

    K(f) = sum_k sinc(f + k) OTF(f + k) over the nearest aliases, where the OTF follows that of the
    Gaussian with the power at f: OTF(f + k) = OTF(f)^(|f + k|^2 / |f|^2).
    """
    terms = _PIXEL * power ** (_STEEP / 2.0)
    kernel = np.maximum(terms.sum(axis=0), math.sqrt(_LEAST))
    return 2.0 * np.log(kernel), (terms * _STEEP).sum(axis=0) / kernel


def _aliases() -> tuple[Floats, Floats]:
    """Sinc of the pixel and relative square of the frequency, shape (9, BINS)."""
    modulus, angle = bin_frequencies()
    fx, fy = modulus * np.cos(angle), modulus * np.sin(angle)
    moves = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    pixel = np.stack([np.sinc(fx + i) * np.sinc(fy + j) for i, j in moves])
    steep = np.stack([((fx + i) ** 2 + (fy + j) ** 2) / modulus**2 for i, j in moves])
    return pixel, steep


_PIXEL, _STEEP = _aliases()
