"""Transfer functions of a tile's kernels, and of how they change within it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.compiled.tile import spectra_of

Transfers = tuple[NDArray[np.complex64], NDArray[np.complex64]]


def transfers(
    blurs: Sequence[UniformBlur],
    shape: tuple[int, int],
    reach: float,
    *,
    drifting: bool = True,
) -> Transfers:
    """Return K, `(channel, rows, cols)`, and its change per pixel, `(channel, 2, rows, cols)`.

    The latter is empty where a kernel has none or `drifting` is false. Each step of a solver inverts K
    alone and takes the change to the other side, as data. That converges only where the change is
    smaller than K, so it is limited to half of K at `reach` pixels from the middle.
    """
    taps = _taps(blurs, drifting=drifting)
    half = shape[1] // 2 + 1
    K = np.empty((len(taps), shape[0], half), dtype=np.complex64)
    rates = np.empty((len(taps) if taps.shape[1] > 1 else 0, 2, shape[0], half), dtype=np.complex64)
    spectra_of(taps, np.float32(reach), shape[1], K, rates)
    return K, rates


def _taps(blurs: Sequence[UniformBlur], *, drifting: bool) -> NDArray[np.float32]:
    """Kernels and their changes per pixel down and across, `(channel, 1 or 3, k, k)`, centred alike."""
    drifts = [(blur.drift.down, blur.drift.across) for blur in blurs if blur.drift is not None]
    drifting = drifting and len(drifts) == len(blurs)
    kernels = [blur.taps for blur in blurs]
    ends = [
        [(before.taps, after.taps, max(pixels, 1.0)) for before, after, pixels in pair] for pair in drifts
    ]
    sides = [kernel.shape[0] for kernel in kernels]
    if drifting:
        sides += [end.shape[0] for pair in ends for both in pair for end in both[:2]]
    side = max(sides)
    taps = np.zeros((len(blurs), 3 if drifting else 1, side, side), dtype=np.float32)

    def place(channel: int, index: int, kernel: NDArray[np.float32], factor: float) -> None:
        low = (side - kernel.shape[0]) // 2
        taps[channel, index, low : side - low, low : side - low] += factor * kernel

    for c, kernel in enumerate(kernels):
        place(c, 0, kernel, 1.0)
    if drifting:
        for c, pair in enumerate(ends):
            for index, (before, after, pixels) in enumerate(pair, start=1):
                place(c, index, before, -1.0 / pixels)
                place(c, index, after, 1.0 / pixels)
    return taps
