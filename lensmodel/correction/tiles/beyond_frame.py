"""Light from beyond the frame: a prediction of the pixels just outside, which were not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.compiled.common import through
from lensmodel.correction.compiled.tile import fill
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.methods.richardson_lucy import first_guess, richardson_lucy_steps
from lensmodel.correction.tiles.canvas import Canvas, seam

_DEPTH, _MORE = 4, 8
"""Depth of the strip of data that predicts what lies beyond a side: so many reaches of the blur, plus so many
pixels (chosen: those within two reaches share light with the outside, as many again share it with them; more
costs time and says nothing of the outside)."""


def fill_outside(
    y: Planes,
    tile: Planes,
    light: NDArray[np.float32],
    K: NDArray[np.complex64],
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    canvas: Canvas,
    steps: int,
) -> None:
    """Predict the margin of a canvas along the sides of the frame, in place.

    A mirror image of the frame is a poor guess: its errors come back as ripples inside, stronger the less
    noise there is. Richardson-Lucy steps on a strip of the data estimate the light on both sides of the
    border, each point divided by the share of its light that was measured; that light, blurred, is what a
    larger sensor would have recorded.

    Parameters
    ----------
    y : Planes
        The canvas, scaled by one over `light`.
    tile : Planes
        The data, none of it beyond saturation.
    light : ndarray, shape (channels,)
        Mean light of each colour.
    K : ndarray, shape (channels, rows, cols)
        Transfer functions on the canvas.
    steps : int
        Richardson-Lucy steps.
    """
    outside = np.ones(canvas.shape, dtype=np.bool_)
    outside[canvas.data] = False
    for c, (plane, blur, sensor) in enumerate(zip(tile, blurs, sensors, strict=True)):
        wide = blur.reach
        if wide > 0:
            latent = _extended(plane, blur, sensor, steps)
            np.copyto(y[c], _predicted(latent, light[c], K[c], canvas, canvas.margin - wide), where=outside)


def _predicted(
    latent: NDArray[np.float32],
    light: np.float32,
    K: NDArray[np.complex64],
    canvas: Canvas,
    margin: int,
) -> NDArray[np.float32]:
    """What a larger sensor would have recorded of the latent light, over `light`, on the canvas."""
    rows, cols = canvas.shape
    predicted = np.empty((1, rows, cols), dtype=np.float32)
    joints = seam(latent.shape[0], rows), seam(latent.shape[1], cols)
    fill(latent[None], np.ones(1, dtype=np.float32) / light, margin, *joints, predicted)
    through(predicted[0], np.empty_like(K), K, forward=True, first=0, last=rows, begin=0, end=rows)
    return np.asarray(predicted[0])


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
