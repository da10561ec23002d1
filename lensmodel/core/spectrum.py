"""What a patch says about its blur without a kernel: its power in rings and sectors, and the tail's side.

The power spectrum tells how wide the blur is in every direction, once for all apertures and photos that
are compared, but nothing of its phase. Of two kernels with equal power, one the other turned by 180
degrees, the right one leaves the sparser gradients when it is taken off: `tail` says so in two numbers.
The phase of red or blue against green (`cross_phase`) says so where focus differs between the colours.
All are small, hold no picture, and can be summed over patches and photos before anything is solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are needed: processes that compute nothing do not wait
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import NoiseModel, Plane

# Bins (chosen): a ring is a fifth wider than the one within it, a sector is 15 degrees of half a turn.
RINGS: Final = 14
SECTORS: Final = 12

RING_LIMITS: Final = (0.03, 0.5)
"""Frequencies of the innermost and outermost ring, cycles/pixel; rings are equally wide in log."""

RING_EDGES: Final = np.geomspace(*RING_LIMITS, RINGS + 1)
"""Frequencies between the rings and at both ends, cycles/pixel."""

FIRST_PHASE_RING: Final = 3
"""Rings below hold too few frequencies of a tile to be told apart by angle."""

PHASE_RINGS: Final = 7
"""Rings from `FIRST_PHASE_RING` on in which phases are known: below a quarter of the sampling rate."""

PHASE_BINS: Final = PHASE_RINGS * SECTORS

_TILE = 64  # pixels of a tile: two periods of the innermost ring; larger ones leave fewer to average (chosen)
# Pixels: no derivative is taken finer than the pixel or wider than kernels are (chosen)
_TAIL_SIGMA = (0.5, 3.0)
_TAIL_POWER = 0.8  # of the gradients: photographs are about as sparse as that
_TAIL_PHASE = 1.5  # radians at most: beyond, frequencies hold little but noise
_TAIL_SOFT_PX = 0.3  # pixels: keeps noise next to Nyquist out of the third derivative (chosen)
_TAIL_RIM = 16  # pixels of the patch's rim, where its window has faded the detail (chosen)
_CORE_PX = (2, 4)  # nearer than this neighbours are alike: for the valley, for the peak
_REPEATS = (-0.4, 0.9)  # correlation at the valley and the peak of what repeats
_BYTES = 4 * (RINGS * SECTORS + 3)  # single precision: the bins, the noise and two asymmetries
_BYTES_OF_PHASE = 4 * 2 * PHASE_BINS


@dataclass(frozen=True, slots=True, eq=False)
class CrossPhase:
    """Phase of one channel against green in the bins of a patch, as its mosaic shows it.

    Parameters
    ----------
    phase : ndarray of float32, shape (PHASE_BINS,)
        Of F_C conj(F_G), radians, at frequencies with rows downwards positive (the angle goes from the
        columns' axis towards the rows', 0 to pi).
    precision : ndarray of float32, shape (PHASE_BINS,)
        Inverse variance; 0 where a bin says nothing.
    """

    phase: NDArray[np.float32]
    precision: NDArray[np.float32]

    def __post_init__(self) -> None:
        both = np.ravel(self.phase), np.ravel(self.precision)
        sizes = {np.shape(self.phase), np.shape(self.precision)}
        if sizes != {(PHASE_BINS,)} or not np.isfinite(both).all() or both[1].min() < 0:
            raise InvalidInputError(
                f"phases and precisions must be finite, {PHASE_BINS} each, the latter not negative; "
                f"got shapes {sorted(sizes)}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PatchSpectrum:
    """Power spectrum of one patch in one channel, and on which side its blur has a tail.

    Parameters
    ----------
    power : ndarray of float32, shape (RINGS, SECTORS)
        Mean power of rings and sectors, noise included, per pixel of the window.
    noise : float
        Power of the noise in the same units.
    tail : tuple of float
        (right, up): positive where taking off a blur with a tail to that side leaves sparser
        gradients than one with a tail to the other. Relative change of mean |gradient|^0.8; its sign
        counts, summed over patches.
    cross : CrossPhase or None
        Of red and blue: phase against green. None where the sensor's own samples are not at hand.
    """

    power: NDArray[np.float32]
    noise: float
    tail: tuple[float, float] = (0.0, 0.0)
    cross: CrossPhase | None = None

    def __post_init__(self) -> None:
        numbers = (*np.ravel(self.power), self.noise, *self.tail)
        if (
            np.shape(self.power) != (RINGS, SECTORS)
            or not np.isfinite(numbers).all()
            or min(numbers[:-2]) < 0
        ):
            raise InvalidInputError(
                f"a patch spectrum must be finite, not negative and of shape {(RINGS, SECTORS)}, "
                f"got {np.shape(self.power)}"
            )

    @classmethod
    def of(
        cls, patch: Plane, noise: NoiseModel, width_px: float, cross: CrossPhase | None = None
    ) -> PatchSpectrum:
        """Measure a patch whose blur has about this root mean square width per axis."""
        power, floor = binned_spectrum(patch, noise)
        return cls(power, floor, tail_of(patch, width_px), cross)

    def to_bytes(self) -> bytes:
        """Serialise to 684 or 1356 bytes: little-endian float32 of power, noise, tail, phase, precision."""
        parts = [self.power.ravel(), np.array([self.noise, *self.tail])]
        if self.cross is not None:
            parts += [self.cross.phase, self.cross.precision]
        return np.concatenate(parts).astype("<f4").tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> PatchSpectrum:
        """Read what `to_bytes` wrote, with phases or without.

        Raises
        ------
        InvalidInputError
            For anything else.
        """
        if len(data) not in {_BYTES, _BYTES + _BYTES_OF_PHASE}:
            raise InvalidInputError(
                f"a patch spectrum takes {_BYTES} bytes, or {_BYTES + _BYTES_OF_PHASE} with phases, "
                f"got {len(data)}"
            )
        values = np.frombuffer(data, dtype="<f4").astype(np.float32)
        power, rest = values[: RINGS * SECTORS].reshape(RINGS, SECTORS), values[RINGS * SECTORS :]
        noise, right, up = (float(v) for v in rest[:3])
        cross = None if len(data) == _BYTES else CrossPhase(rest[3 : 3 + PHASE_BINS], rest[3 + PHASE_BINS :])
        return cls(power, noise, (right, up), cross)


def binned_spectrum(patch: Plane, noise: NoiseModel) -> tuple[NDArray[np.float32], float]:
    """Mean periodogram of Hann-windowed 64 px tiles at half overlap, in rings and sectors.

    Returns
    -------
    spectrum : ndarray of float32, shape (RINGS, SECTORS)
        Power per pixel of the window, noise included; frequencies 0.03 to 0.5 cycles/pixel.
    floor : float
        Power of the noise alone.
    """
    side = min(_TILE, *patch.shape)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(side) + 0.5) / side)
    window = hann[:, None] * hann[None, :]
    energy = float((window**2).sum())
    total = np.zeros((side, side // 2 + 1))
    count = 0
    for row in range(0, patch.shape[0] - side + 1, side // 2):
        for col in range(0, patch.shape[1] - side + 1, side // 2):
            tile = patch[row : row + side, col : col + side].astype(np.float64)
            total += np.abs(scipy.fft.rfft2((tile - tile.mean()) * window)) ** 2
            count += 1
    power = total / (count * energy)
    f_row, f_col = np.meshgrid(scipy.fft.fftfreq(side), scipy.fft.rfftfreq(side), indexing="ij")
    frequency, angle = np.hypot(f_row, f_col), np.mod(np.arctan2(f_row, f_col), np.pi)
    ring = np.searchsorted(RING_EDGES, frequency, side="right") - 1
    sector = np.minimum((angle / np.pi * SECTORS).astype(int), SECTORS - 1)
    spectrum = np.zeros((RINGS, SECTORS), dtype=np.float32)
    for i in range(RINGS):
        in_ring = ring == i
        mean = float(power[in_ring].mean()) if in_ring.any() else 0.0
        for j in range(SECTORS):
            bin_ = in_ring & (sector == j)
            spectrum[i, j] = float(power[bin_].mean()) if bin_.any() else mean
    return spectrum, float(noise.sigma_at(float(patch.mean())) ** 2)


def bin_frequencies(first_ring: int = FIRST_PHASE_RING) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles of the bins, rings from `first_ring` on.

    Returns
    -------
    modulus, angle : ndarray of float64, shape (n,)
        Cycles/pixel; radians from the columns' axis towards the rows', 0 to pi.
    """
    middle = np.sqrt(RING_EDGES[1:] * RING_EDGES[:-1])[first_ring:]
    angle = (np.arange(SECTORS) + 0.5) * math.pi / SECTORS
    modulus, turned = np.meshgrid(middle, angle, indexing="ij")
    return modulus.ravel(), turned.ravel()


def tail_of(patch: Plane, width_px: float) -> tuple[float, float]:
    """Which sides, (right, up), the tail of a patch's blur lies on.

    A kernel with the third moment k along a unit vector has the phase k w^3 / 6 there. Phases of such
    a kernel of skewness 1 are taken off, once with the tail to one side and once to the other, and
    the sparsity of the gradients is compared: blur removed in the wrong direction doubles edges.

    Parameters
    ----------
    patch : Plane, shape (h, w)
        At least 40 x 40.
    width_px : float
        About the root mean square width per axis of its blur.
    """
    height, width = patch.shape
    if min(height, width) < 2 * _TAIL_RIM + 8:
        raise InvalidInputError(f"a patch must measure at least 40 x 40 pixels, got {height} x {width}")
    values = patch.astype(np.float64)
    window = np.sqrt(np.hanning(height)[:, None] * np.hanning(width)[None, :])
    down, right = np.meshgrid(scipy.fft.fftfreq(height), scipy.fft.rfftfreq(width), indexing="ij")
    across, up = 2.0 * np.pi * right, -2.0 * np.pi * down
    square = across**2 + up**2
    spectrum = scipy.fft.rfft2((values - values.mean()) * window) * np.exp(-0.5 * _TAIL_SOFT_PX**2 * square)
    skew = float(np.clip(width_px, *_TAIL_SIGMA)) ** 3 / 6.0
    asymmetries = []
    for along in (across, up):
        phase = np.clip(skew * along * square, -_TAIL_PHASE, _TAIL_PHASE)
        towards, away = (
            _sparsity(scipy.fft.irfft2(spectrum * np.exp(sign * 1j * phase), s=patch.shape))
            for sign in (-1, 1)
        )
        asymmetries.append((away - towards) / max(away + towards, 1e-12))
    return asymmetries[0], asymmetries[1]


def _sparsity(image: NDArray[np.float64]) -> float:
    """Mean |gradient|^0.8 over that of a normal distribution of the same power; small is sparse."""
    inner = image[_TAIL_RIM:-_TAIL_RIM, _TAIL_RIM:-_TAIL_RIM]
    down, right = np.diff(inner, axis=0), np.diff(inner, axis=1)
    scale = float(np.sqrt((down**2).mean() + (right**2).mean())) + 1e-12
    return float((np.abs(down / scale) ** _TAIL_POWER).mean() + (np.abs(right / scale) ** _TAIL_POWER).mean())


def repeats(patch: Plane) -> bool:
    """Whether a patch repeats itself like a fence or an arcade, so that no blur can be told from it.

    Its autocorrelation then falls far below zero and comes back nearly to one.
    """
    power = np.abs(scipy.fft.rfft2((patch - patch.mean()).astype(np.float64))) ** 2
    correlation = scipy.fft.irfft2(power, s=patch.shape)
    if not correlation[0, 0] > 0:
        return False
    correlation /= correlation[0, 0]
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in patch.shape)
    gap = np.hypot(rows[:, None], cols[None, :])
    reach = gap < min(patch.shape) // 3
    valley = float(correlation[(gap > _CORE_PX[0]) & reach].min())
    peak = float(correlation[(gap > _CORE_PX[1]) & reach].max())
    return valley < _REPEATS[0] and peak > _REPEATS[1]
