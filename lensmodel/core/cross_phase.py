"""The phase between two colours of a mosaic: what a patch says of its blur, free of the scene.

One scene S is seen by two channels through the transfer functions H_C and H_G. The mean of the cross
spectrum over tiles is E|S|^2 H_C conj(H_G), its phase that of H_C conj(H_G): the scene's own phase cancels
as far as its colours have edges in the same places. Turned by 180 degrees, a lens has the opposite phases,
where its power spectra are the same.

Only samples that the sensor took count, since demosaicing copies green's detail into red and blue. The
sites of one colour are a lattice of every second pixel, so that frequencies below a quarter of the sampling
rate are known. A lattice that begins at (row, col) = o has the transform

    F(f) = exp(-2 pi i f.o) sum_n v(o + 2 n) exp(-2 pi i f.(2 n)),

and green, whose two lattices are added, no alias at half the sampling rate along one axis. A shift between
the channels (lateral colour) is a phase linear in f; it says nothing of blur, and is left free wherever
phases are compared.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are needed: processes that compute nothing do not wait
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.spectrum import (
    FIRST_PHASE_RING,
    PHASE_BINS,
    PHASE_RINGS,
    RING_EDGES,
    SECTORS,
    CrossPhase,
)
from lensmodel.core.types import CHANNELS, BayerPattern, Channel, Planes

Floats = NDArray[np.float64]
Waves = NDArray[np.complex128]

_TILE = 64  # pixels, as in `PatchSpectrum`
_HALF = _TILE // 2  # sites of one lattice along a tile
# Neighbours under a Hann window that count as one: (1 + 2 (2/3)^2 + 2 (1/6)^2)^2, by the squared
# correlations of its transform (F. J. Harris, Proc. IEEE 66, 1978)
_INDEPENDENT = 3.8
# Independent share of half-overlapping tiles: (1 + 2 (1/6)^2)^-2 (P. D. Welch, IEEE Trans. AU-15, 1967)
_OVERLAP = 0.9
_SCATTER = 0.05  # radians: what a scene's colours leave in a bin (`lab.model.cross_spectra`)
# Shifts that are tried first (chosen: beyond usual lateral colour)
_REACH_PX, _STEP_PX = 4.0, 0.5
_SHIFT_ROUNDS = 6  # of Gauss and Newton (chosen: far below a hundredth of a pixel from such a start)

_AXIS = np.fft.fftfreq(_HALF) / 2.0  # cycles/pixel of the full lattice
_ROW, _COL = (grid.ravel() for grid in np.meshgrid(_AXIS, _AXIS, indexing="ij"))
_MODULUS = np.hypot(_ROW, _COL)
_UPPER = (_ROW > 0) | ((_ROW == 0) & (_COL > 0))
_RING = np.searchsorted(RING_EDGES, _MODULUS, side="right") - 1 - FIRST_PHASE_RING
_KEPT = np.flatnonzero(_UPPER & (_RING >= 0) & (_RING < PHASE_RINGS))
_BIN = _RING[_KEPT] * SECTORS + np.minimum(
    (np.arctan2(_ROW[_KEPT], _COL[_KEPT]) / math.pi * SECTORS).astype(int), SECTORS - 1
)
_COUNT = np.bincount(_BIN, minlength=PHASE_BINS)
_FREQUENCY = np.stack([_ROW[_KEPT], _COL[_KEPT]], axis=1)

MIDDLES: Final[Floats] = np.stack(
    [np.bincount(_BIN, axis, PHASE_BINS) / np.maximum(_COUNT, 1) for axis in _FREQUENCY.T], axis=1
)
"""Mean frequency (row, col) of each bin, cycles/pixel, shape (PHASE_BINS, 2); bins of none are at 0."""


def cross_phase(planes: Planes, cfa: BayerPattern, channel: Channel) -> CrossPhase:
    """Measure the phase of a channel against green in a patch.

    Parameters
    ----------
    planes : Planes, shape (3, h, w)
        At least 64 x 64; only each plane's own sites count.
    cfa : BayerPattern
        Which channel the patch's top left 2 x 2 pixels measured.
    channel : {"r", "b"}

    Returns
    -------
    CrossPhase
        After the shift by which the two channels agree best.
    """
    summed = _coherent_in_bins(planes, cfa, channel)
    tiles = math.prod((n - _TILE) // _HALF + 1 for n in planes.shape[1:])
    samples = _OVERLAP * tiles * np.maximum(_COUNT / _INDEPENDENT, 1.0)
    # |mean|^2 of few samples is too large by one over their number
    squared = (samples * np.abs(summed) ** 2 - 1.0) / np.maximum(samples - 1.0, 1e-3)
    squared = np.clip(squared, 1e-6, 1.0 - 1e-6)
    variance = (1.0 - squared) / (2.0 * samples * squared)
    precision = np.where((_COUNT > 0) & (samples > 1.0), 1.0 / (variance + _SCATTER**2), 0.0)
    return CrossPhase(np.angle(summed).astype(np.float32), precision.astype(np.float32))


def coherence(planes: Planes, cfa: BayerPattern, channel: Channel) -> Floats:
    """How much a channel of a patch has in common with green, 0 to 1, shape (PHASE_BINS,)."""
    return np.abs(_coherent_in_bins(planes, cfa, channel))


def _coherent_in_bins(planes: Planes, cfa: BayerPattern, channel: Channel) -> Waves:
    cross, own, green = spectra_in_bins(planes, cfa, channel)
    return cross / np.sqrt(np.maximum(own * green, 1e-30))


def spectra_in_bins(planes: Planes, cfa: BayerPattern, channel: Channel) -> tuple[Waves, Floats, Floats]:
    """Sums of `cross_spectra` in the bins, each (PHASE_BINS,), after the shift by which both agree best."""
    cross, own, green = cross_spectra(planes, cfa, channel)
    coherent = cross / np.sqrt(np.maximum(own * green, 1e-30))
    cross = cross * np.exp(-2j * math.pi * (_FREQUENCY @ _shift(coherent)))
    return binned(cross), binned(own).real, binned(green).real


def noise_in_bins(cfa: BayerPattern, channel: Channel) -> Floats:
    """What `spectra_in_bins` gives as power of white noise of variance 1, shape (PHASE_BINS,)."""
    index = CHANNELS.index(channel)
    sites = ((row, col) for row in (0, 1) for col in (0, 1) if cfa[row][col] == index)
    energy = sum(float((_window(*first) ** 2).sum()) for first in sites)
    return np.asarray(energy * _COUNT, dtype=np.float64)


def cross_spectra(planes: Planes, cfa: BayerPattern, channel: Channel) -> tuple[Waves, Floats, Floats]:
    """Mean cross spectrum of a channel with green over Hann-windowed tiles, and both powers.

    Returns
    -------
    cross : ndarray of complex128, shape (n,)
    own, green : ndarray of float64, shape (n,)
        At the n frequencies of `_FREQUENCY`.
    """
    index = CHANNELS.index(channel)
    height, width = planes.shape[1:]
    if min(height, width) < _TILE:
        raise InvalidInputError(f"a patch must measure at least 64 x 64 pixels, got {height} x {width}")
    cross: Waves = np.zeros(len(_KEPT), dtype=np.complex128)
    own, green = np.zeros(len(_KEPT)), np.zeros(len(_KEPT))
    tops, lefts = range(0, height - _TILE + 1, _HALF), range(0, width - _TILE + 1, _HALF)
    for top in tops:
        for left in lefts:
            tile = planes[:, top : top + _TILE, left : left + _TILE].astype(np.float64)
            seen, light = _transform(tile[index], cfa, index), _transform(tile[1], cfa, 1)
            cross += seen * light.conj()
            own += np.abs(seen) ** 2
            green += np.abs(light) ** 2
    count = len(tops) * len(lefts)
    return cross / count, own / count, green / count


def log_likelihood(measured: CrossPhase, phase: Floats) -> float:
    """How likely phases are by what was measured, up to a constant, after the shift that suits best.

    sum precision cos(measured - phase - 2 pi f.s), largest by s.
    """
    return float(measured.precision @ np.cos(unshifted(measured, phase)))


def unshifted(measured: CrossPhase, phase: Floats | float = 0.0) -> Floats:
    """Measured less other phases, after the shift that suits best; shape (PHASE_BINS,), in -pi to pi."""
    left, precision = measured.phase - phase, measured.precision.astype(np.float64)
    along = 2.0 * math.pi * MIDDLES
    normal = along.T @ (precision[:, None] * along) + 1e-9 * np.eye(2)
    for _ in range(_SHIFT_ROUNDS):
        left = left - along @ np.linalg.solve(normal, along.T @ (precision * np.sin(left)))
    return np.asarray(np.angle(np.exp(1j * left)))


def without_linear(columns: Floats, precision: NDArray[np.floating]) -> Floats:
    """Columns of shape (PHASE_BINS, n) less the part that a shift makes, by least squares."""
    weighted = precision[:, None] * MIDDLES
    normal = MIDDLES.T @ weighted + 1e-12 * np.eye(2)
    return np.asarray(columns - MIDDLES @ np.linalg.solve(normal, weighted.T @ columns))


def mean_in_bins(values: Waves) -> Waves:
    """Mean of values on the 64 x 64 grid of `numpy.fft.fft2` in each bin, shape (PHASE_BINS,)."""
    rows, cols = (np.rint(axis * _TILE).astype(int) for axis in _FREQUENCY.T)
    return binned(values[rows, cols]) / np.maximum(_COUNT, 1)


def _window(row: int, col: int) -> Floats:
    """Hann window of a tile at the sites of the lattice that begins at (row, col)."""
    down, right = (
        0.5 - 0.5 * np.cos(2.0 * math.pi * (np.arange(first, _TILE, 2) + 0.5) / _TILE) for first in (row, col)
    )
    return np.asarray(down[:, None] * right[None, :])


def _transform(tile: Floats, cfa: BayerPattern, channel: int) -> Waves:
    """Transform of one colour's own sites at the frequencies that count."""
    total = np.zeros(len(_KEPT), dtype=complex)
    for row in (0, 1):
        for col in (0, 1):
            if cfa[row][col] != channel:
                continue
            window = _window(row, col)
            sites = tile[row::2, col::2]
            light = (sites - (sites * window).sum() / window.sum()) * window
            ramp = np.exp(-2j * math.pi * (_FREQUENCY @ (row, col)))
            total += scipy.fft.fft2(light).ravel()[_KEPT] * ramp
    return total


def binned(values: NDArray[np.number]) -> Waves:
    """Sum of what `cross_spectra` gives in each bin, shape (PHASE_BINS,)."""
    real, imaginary = (np.bincount(_BIN, part, PHASE_BINS) for part in (np.real(values), np.imag(values)))
    return np.asarray(real + 1j * imaginary)


def _shift(coherent: Waves) -> Floats:
    """Shift (row, col) in pixels that brings two channels together: phase = 2 pi f.shift."""
    steps = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    trials = np.stack([axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij")], axis=1)
    agreed = (np.exp(-2j * math.pi * (trials @ _FREQUENCY.T)) @ coherent).real
    shift = trials[int(np.argmax(agreed))]
    along = 2.0 * math.pi * _FREQUENCY
    strength = np.abs(coherent) ** 2
    normal = along.T @ (strength[:, None] * along) + 1e-9 * np.eye(2)
    for _ in range(_SHIFT_ROUNDS):
        left = np.sin(np.angle(coherent) - along @ shift)
        shift = shift + np.linalg.solve(normal, along.T @ (strength * left))
    return np.asarray(shift)
