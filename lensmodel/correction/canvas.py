"""The periodic canvas on which Fourier methods see a tile, and the light from beyond the frame on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from lensmodel.core.numerics import jit
from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur, fast_shape
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.methods.richardson_lucy import first_guess, richardson_lucy_steps
from lensmodel.correction.transforms import ONE, Real, through

BLOCK: Final = 4  # pixels of a coarse plane's block: coarser than detail, finer than objects (chosen)

_JOINT: Final = 4
"""Pixels over which the ends of a tile fade into each other where its rim is cut off (chosen: with none, the
step between the ends rings inwards; more is computed for nothing)."""
_DEPTH, _MORE = 4, 8
"""Depth of the strip of data that predicts what lies beyond a side: so many reaches of the blur, plus so many
pixels (chosen: those within two reaches share light with the outside, as many again share it with them; more
costs time and says nothing of the outside)."""

Seam = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A periodic grid that holds `rows` x `cols` data, and before them `margin` pixels without.

    After the data there are at least as many.
    """

    rows: int
    cols: int
    margin: int

    @classmethod
    def around(cls, tile: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]) -> Canvas:
        """Canvas for a tile `(channel, row, col)`.

        The margin is at least the kernel's side wide in total, so that light which wraps around
        never meets data from the other end. Where the tile's rim will be cut off, it need only join
        the ends without a step.
        """
        wide = max(blur.reach for blur in blurs)
        margin = min(_JOINT, wide) if all(sensor.surrounded for sensor in sensors) else wide
        return cls(tile.shape[1], tile.shape[2], margin)

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the grid, quick to transform."""
        return fast_shape((self.rows + 2 * self.margin, self.cols + 2 * self.margin))

    @property
    def data(self) -> tuple[slice, slice]:
        """Where the data lie on the grid."""
        return slice(self.margin, self.margin + self.rows), slice(self.margin, self.margin + self.cols)

    def filled(
        self,
        tile: Planes,
        light: NDArray[np.float32],
        K: NDArray[np.complex64],
        blurs: Sequence[UniformBlur],
        sensors: Sequence[Sensor],
        steps: int,
    ) -> Planes:
        """Place a tile, none of it beyond saturation and divided by the `light` of each colour.

        Its margin fades from one end to the other, but for what lies beyond the sides of the frame. A mirror
        image of the frame is a poor guess of that: its errors come back as ripples inside, stronger the less
        noise there is. `steps` of Richardson-Lucy on a strip of the data estimate the light on both sides of
        the border, each point divided by the share of its light that was measured; that light, blurred by K,
        is what a larger sensor would have recorded.
        """
        y = np.empty((len(tile), *self.shape), dtype=np.float32)
        _fill(tile, ONE / light, self.margin, *self._seams(self.rows, self.cols), y)
        if all(sensor.surrounded for sensor in sensors):
            return y
        outside = np.ones(self.shape, dtype=np.bool_)
        outside[self.data] = False
        for c, (plane, blur, sensor) in enumerate(zip(tile, blurs, sensors, strict=True)):
            if blur.reach == 0:
                continue
            latent = _extended(plane, blur, sensor, steps)
            recorded = np.empty((1, *self.shape), dtype=np.float32)
            seams = self._seams(*latent.shape)
            _fill(latent[None], np.ones(1, np.float32) / light[c], self.margin - blur.reach, *seams, recorded)
            rows = self.shape[0]
            through(recorded[0], np.empty_like(K[c]), K[c], True, 0, rows, 0, rows)
            np.copyto(y[c], recorded[0], where=outside)
        return y

    def _seams(self, rows: int, cols: int) -> tuple[Seam, Seam]:
        return _seam(rows, self.shape[0]), _seam(cols, self.shape[1])


@lru_cache(maxsize=64)
def _seam(rows: int, length: int) -> Seam:
    """Rows to fade from and to beyond `rows`, up to `length`, and the share of the latter."""
    t = np.arange(length - rows)
    fade = ((t + 0.5) / max(length - rows, 1)).astype(np.float32)
    return np.maximum(rows - 1 - t, 0), np.minimum(length - rows - 1 - t, rows - 1), fade


def fitted_halo(cell: tuple[int, int], least: int) -> int:
    """Widest halo of a cell for which its canvas is no larger than for the least one.

    Sizes that are quick to transform are few: the pixels that a canvas has to spare are better filled with
    data than with a longer seam.
    """
    needed = tuple(extent + 2 * (least + _JOINT) for extent in cell)
    return least + min(np.subtract(fast_shape(needed), needed)) // 2


@jit
def _fill(planes: Real, gains: Real, margin: int, rows: Seam, cols: Seam, y: Real) -> None:
    """Place planes times `gains` on a canvas; the margin fades from one end to the other."""
    channels, high, wide = planes.shape
    height, width = y.shape[1], y.shape[2]
    line = np.empty(wide, np.float32)
    for c in range(channels):
        for i in range(height):
            if i < high:
                for j in range(wide):
                    line[j] = planes[c, i, j] * gains[c]
            else:
                a, b, t = rows[0][i - high], rows[1][i - high], rows[2][i - high]
                for j in range(wide):
                    line[j] = (planes[c, a, j] * (ONE - t) + planes[c, b, j] * t) * gains[c]
            row = (i + margin) % height
            y[c, row, margin : margin + wide] = line
            for j in range(wide, width):
                t = cols[2][j - wide]
                value = line[cols[0][j - wide]] * (ONE - t) + line[cols[1][j - wide]] * t
                y[c, row, (j + margin) % width] = value


def _extended(
    plane: NDArray[np.float32], blur: UniformBlur, sensor: Sensor, steps: int
) -> NDArray[np.float32]:
    """The data, extended by the reach; at the sides of the frame they are replaced by the latent light."""
    wide = blur.reach
    depth, both = _DEPTH * wide + _MORE, 2 * wide
    wider = np.pad(plane, wide, mode="symmetric" if wide <= min(plane.shape) else "edge")
    unclipped = replace(sensor, clip=float("inf"), measured=None)

    def light_of(part: NDArray[np.float32]) -> NDArray[np.float32]:
        part = np.ascontiguousarray(part)
        latent, reach = first_guess(part, blur)
        return richardson_lucy_steps(latent, part, reach, blur, unclipped, steps=steps)

    top, bottom, left, right = sensor.edges
    if left:
        wider[:, :both] = light_of(plane[:, :depth])[:, :both]
    if right:
        wider[:, -both:] = light_of(plane[:, -depth:])[:, -both:]
    if top:
        wider[:both] = light_of(plane[:depth])[:both]
    if bottom:
        wider[-both:] = light_of(plane[-depth:])[-both:]
    return wider


def spread_blocks(blocks: NDArray[np.float32], canvas: Canvas) -> NDArray[np.float32]:
    """Interpolate a coarse plane linearly onto a canvas, its margin cross-faded like the data's."""
    height, width = canvas.shape
    across = _interpolation(canvas.cols, canvas.margin, width) @ np.ascontiguousarray(blocks.T)
    return np.asarray(
        _interpolation(canvas.rows, canvas.margin, height) @ np.ascontiguousarray(across.T), dtype=np.float32
    )


@lru_cache(maxsize=64)
def _interpolation(extent: int, margin: int, length: int) -> scipy.sparse.csr_array:
    """Matrix that takes blocks of `extent` pixels to a canvas of `length`."""
    starts = np.arange(0, extent, BLOCK)
    middles = (starts + np.minimum(starts + BLOCK, extent) - 1) / 2.0
    t = np.arange(extent)
    fine = np.stack([np.interp(t, middles, row) for row in np.eye(starts.size)], axis=1).astype(np.float32)
    first, second, fade = _seam(extent, length)
    bridge = fine[first] * (1 - fade)[:, None] + fine[second] * fade[:, None]
    return scipy.sparse.csr_array(np.roll(np.concatenate([fine, bridge]), margin, axis=0))
