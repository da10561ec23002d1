"""What the light far from the core of true PSFs is worth.

    python -m lensmodel.lab.chain.wings --grids GRID.npz ... [--seeds 1 3]

No photo is taken. For each lens, by zone (medians over places): the share of light outside the 9 x 9 pixels
about the centre of mass; the gain of a linear filter by the true PSF; by those pixels alone; and by the
true modulus without phase. The scene falls off with 1/f^2.4, has a standard deviation of 0.17 of full
scale, and noise of 0.01; everything is compared after its own best shift, since no blind method knows where
a picture lies. A few seconds a lens.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import otf
from lensmodel.core.types import ZONES, Kernel, Zone
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, lenses, seed_range

SIZE: Final = 55  # pixels of a true kernel: what the grids hold
CORE: Final = 4
"""Pixels: the core is the square that reaches so far from the middle pixel, which is the centre of mass."""
_CORE = (slice(SIZE // 2 - CORE, SIZE // 2 + CORE + 1),) * 2
GRID: Final = (256, 256)  # pixels of the scene (chosen): some kernels wide
SLOPE, CONTRAST, NOISE = 2.4, 0.03, 1e-4
"""Exponent of the power of the scene, its variance, and that of the noise."""

Spectrum = NDArray[np.complex128]
_ROWS, _COLS = np.fft.fftfreq(GRID[0])[:, None], np.fft.rfftfreq(GRID[1])[None, :]
_TIMES = np.where((_COLS == 0.0) | (_COLS == 0.5), 1.0, 2.0)  # how often the whole spectrum holds each


def _scene() -> NDArray[np.float64]:
    frequency = np.hypot(_ROWS, _COLS)
    power = np.where(frequency > 0.0, np.maximum(frequency, 1e-9) ** -SLOPE, 0.0)
    return np.asarray(power * CONTRAST * GRID[0] * GRID[1] / (_TIMES * power).sum())


_SCENE = _scene()


def _least_error(passed: Spectrum, noise: NDArray[np.float64] | float) -> float:
    """Mean squared error of a picture after the shift that makes it least."""

    def error(shift: NDArray[np.float64]) -> float:
        turned = passed * np.exp(-2j * np.pi * (_ROWS * shift[0] + _COLS * shift[1]))
        return float((_TIMES * (np.abs(1.0 - turned) ** 2 * _SCENE + noise)).sum())

    return float(minimize(error, np.zeros(2), method="Nelder-Mead", options={"xatol": 0.02}).fun)


def gain(truth: Kernel, by: Spectrum) -> float:
    """Gain in dB of the linear filter of least error for a transfer function, behind a true kernel."""
    passed = otf(truth, GRID)
    linear = by.conj() * _SCENE / (np.abs(by) ** 2 * _SCENE + NOISE)
    before = _least_error(passed, NOISE)
    return float(10.0 * np.log10(before / _least_error(passed * linear, np.abs(linear) ** 2 * NOISE)))


def core_of(kernel: Kernel) -> Kernel:
    """The core alone, of sum 1."""
    inside = np.zeros_like(kernel)
    inside[_CORE] = kernel[_CORE]
    return inside / inside.sum()


def _in_zone(zone: Zone) -> list[int]:
    return [i for i, place in enumerate(PLACES) if zone_of(place.r) == zone]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    wanted = parser.parse_args()
    print("| lens | light outside 9 x 9 px, center / mid / corner | true PSF, dB | its core | its modulus |")
    print("|---|---|---|---|---|")
    seeds = [seed for part in wanted.seeds for seed in part]
    for lens in lenses(seeds, wanted.grids, CAMERA.full_well_electrons):
        truth = lens.lens.field(lens.settings)
        kernels = [truth.kernel_at(place, "g", SIZE) for place in PLACES]
        table = []
        for kernel in kernels:
            beyond = 1.0 - float(kernel[_CORE].sum() / kernel.sum())
            of_true = otf(kernel, GRID)
            table.append(
                [
                    beyond,
                    gain(kernel, of_true),
                    gain(kernel, otf(core_of(kernel), GRID)),
                    gain(kernel, np.abs(of_true).astype(np.complex128)),
                ]
            )
        rows = np.array([np.median(np.array(table)[_in_zone(zone)], axis=0) for zone in ZONES])
        light = " / ".join(f"{share:.0%}" for share in rows[:, 0])
        rest = " | ".join(" / ".join(f"{v:+.1f}" for v in rows[:, k]) for k in (1, 2, 3))
        print(f"| {lens.name} | {light} | {rest} |", flush=True)


if __name__ == "__main__":
    main()
