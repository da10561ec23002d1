"""One pass: a linear filter for all colours together, gentle where the picture is calm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Plane, Planes, StepHook, ignore_step
from lensmodel.correction.blur import BlurOperator, UniformBlur
from lensmodel.correction.clipped import Lights
from lensmodel.correction.compiled.one_pass import one_pass
from lensmodel.correction.compiled.tile import fill
from lensmodel.correction.deconvolver import Deconvolver, Restored, Sensor, Solution, restore_planes, uniform
from lensmodel.correction.methods.sparse_gradient import SparseGradient
from lensmodel.correction.methods.wiener import frequency_squared, prior
from lensmodel.correction.tiles.beyond_frame import fill_outside
from lensmodel.correction.tiles.canvas import Canvas, seam
from lensmodel.correction.tiles.local_statistics import (
    BLOCK,
    BlockMeans,
    signal_variance,
    smoothed,
    spread_blocks,
)
from lensmodel.correction.tiles.transfers import transfers

_FINE: Final = 1.0 / 16.0  # cycles per pixel: a window of 13 pixels sees frequencies above this
_LEAST_COLOUR: Final = 0.02
"""Least variance of chroma over that of luma in a scene (chosen: with none, a scene that looks grey in its
noise would lose every colour; with much more, noise would pass for colour)."""


def _steps() -> Deconvolver:
    """Half the steps of "standard", each a larger one."""
    return SparseGradient(steps=4, coupling=4.0, growth=6.0)


@dataclass(frozen=True, slots=True)
class DirectFilter:
    r"""Linear minimum-mean-square-error filter of three colours, for two contrasts of the scene.

    The scene is natural in luma and in chroma, S_l = l |f|^-2.2 and S_c = c |f|^-2.2, so that each of its
    colours informs the others. With channels scaled to equal light, noise n_i and 1 a vector of ones::

        M = diag( (|K_i|² + floor) / n_i + 1 / S_c ) + g 1 1',    g = ( 1 / S_l - 1 / S_c ) / 3
        X = M^-1 ( conj(K_i) Y_i / n_i )

    solved by the Sherman-Morrison formula. It is solved for a busy scene and for a calm one, and
    each pixel mixes the two by the logarithm of the contrast around it. Mosaics, where two colours of three
    must be filled in, are restored in a few half-quadratic steps instead.

    Parameters
    ----------
    busy, calm : float
        The two contrasts: shares of the mean variance in windows of the tile.
    floor : float
        Added to |K_i|² in M: the square of what a transfer function is expected to be off by within a
        cell. Without it strong frequencies of the scene come back as coloured ripples.
    light_steps : int
        Steps that estimate the light of clipped pixels.
    outside_steps : int
        Steps that estimate the light from beyond the frame.
    """

    busy: float = 0.25
    calm: float = 0.0015
    floor: float = 1e-3
    light_steps: int = 15
    outside_steps: int = 10
    mosaic: Deconvolver = field(default_factory=_steps)

    cell_factor = 2
    """Cells may be larger: a filter that is quick has no use for kernels that are exact everywhere."""

    def deconvolve(
        self, blurred: Plane, blur: BlurOperator, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        kernel = uniform(blur, "fast")
        restored = self.deconvolve_planes(np.stack([blurred] * 3), [kernel] * 3, [sensor] * 3)
        on_step(1, 1)
        return Restored(restored.planes[0], steps=1)

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Restore the colours together; see `ColourDeconvolver`."""
        if any(sensor.measured is not None for sensor in sensors):
            return restore_planes(self.mosaic, blurred, blurs, sensors)
        lights = Lights.of(blurred, blurs, sensors, self.light_steps)
        photo, blurred = blurred, blurred if lights is None else lights.rest
        light = np.maximum(blurred.mean(axis=(1, 2)), 1e-4).astype(np.float32)
        canvas = Canvas.around(blurred, blurs, sensors)
        contrast, colour, noise = _contrasts(BlockMeans.of(blurred, light), light, sensors)
        mean = float(contrast.mean())
        low, high = np.log(self.calm), np.log(self.busy)
        share = np.clip((np.log(contrast / mean) - low) / (high - low), 0.0, 1.0)
        busy = spread_blocks(share.astype(np.float32), canvas)
        K, _ = transfers(blurs, canvas.shape, 1.0, drifting=False)
        levels = np.array(
            [[3.0 * mean * f, max(colour, _LEAST_COLOUR * 3.0 * mean) * f] for f in (self.busy, self.calm)]
        )
        y = np.empty((len(blurred), *canvas.shape), dtype=np.float32)
        rows, cols = seam(canvas.rows, canvas.shape[0]), seam(canvas.cols, canvas.shape[1])
        fill(blurred, np.float32(1.0) / light, canvas.margin, rows, cols, y)
        if not all(sensor.surrounded for sensor in sensors):
            fill_outside(y, blurred, light, K, blurs, sensors, canvas, self.outside_steps)
        x = np.empty_like(y)
        floor = np.float32(self.floor)
        one_pass(x, y, K, noise, prior(canvas.shape)[0], _fine(canvas.shape), levels, busy, floor)
        restored = x[:, canvas.data[0], canvas.data[1]] * light[:, None, None]
        return Solution(restored if lights is None else lights.put_back(photo, restored))


def _contrasts(
    blocks: BlockMeans, light: NDArray[np.float32], sensors: Sequence[Sensor]
) -> tuple[NDArray[np.float32], float, NDArray[np.float32]]:
    """Variance of luma around each block, of chroma in all, and of the noise of each colour.

    Chroma is read off the blocks: what is finer is noise.
    """
    var = np.stack(
        [
            s.noise.variance(smoothed(b * bright)) / bright**2
            for s, b, bright in zip(sensors, blocks.planes, light, strict=True)
        ]
    ).astype(np.float32)
    noise = np.maximum(var.mean(axis=(1, 2)), np.float32(1e-9))
    contrast = signal_variance(blocks, var.sum(axis=0) / np.float32(9.0))
    r, g, b = blocks.planes
    chroma = 0.0
    for plane, part in (
        ((r - b) / np.float32(np.sqrt(2)), (noise[0] + noise[2]) / 2),
        ((2 * g - r - b) / np.float32(np.sqrt(6)), (noise[0] + 4 * noise[1] + noise[2]) / 6),
    ):
        detail = float((smoothed(plane * plane) - smoothed(plane) ** 2).mean())
        chroma += max(detail - float(part) / BLOCK**2, 0.0) / 2.0
    return contrast, chroma, noise


@lru_cache(maxsize=8)
def _fine(shape: tuple[int, int]) -> NDArray[np.float32]:
    """The prior's power where a local window sees it, zero elsewhere."""
    prior_power = prior(shape)[1] * (frequency_squared(shape) > _FINE**2)
    prior_power.setflags(write=False)
    return np.ascontiguousarray(prior_power, dtype=np.float32)
