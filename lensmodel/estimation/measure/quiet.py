"""How strong noise can be at most: the finest detail of the quietest place of a photo.

Where a scene has detail everywhere, as one for an aperture pair should, no flat place shows the noise, and
detail passes for noise: of a simulated scene of leaves and grain `photo.estimate_noise` said sixty times too
much. Noise is also in the finest detail of the quietest place, with whatever scene is there: the power there
is an upper bound; a photo taken wide open, whose lens took the finest detail away, comes close to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import CHANNELS, NoiseModel
from lensmodel.photo import LinearPhoto
from lensmodel.photo.values import PlaneNoise

_BLOCK: Final = 64
"""Pixels, side of a place: a larger one is nowhere without detail, a smaller one by chance too quiet
(chosen)."""
_FINE: Final = (0.4, 0.5)
"""Frequencies in cycles/pixel: above them grids of pixels hold nothing, below them lenses leave more."""

_DARK: Final = 0.02  # of saturation: darker blocks show the black level rather than light (chosen)


def with_bounded_noise(photos: list[LinearPhoto]) -> list[LinearPhoto]:
    """Return photos whose noise is no stronger than their quietest places show.

    Photos of one camera at one ISO share the bound, since they share the sensor's noise.
    """
    bounds = [[quietest(photo, channel) for channel in range(len(CHANNELS))] for photo in photos]
    bounded = []
    for photo in photos:
        alike = [bounds[i] for i, other in enumerate(photos) if _one_sensitivity(photo, other)]
        least = np.min(alike, axis=0)
        sensor = None if photo.sensor_noise is None else _all_bounded(photo.sensor_noise, least)
        bounded.append(replace(photo, noise=_all_bounded(photo.noise, least), sensor_noise=sensor))
    return bounded


def quietest(photo: LinearPhoto, channel: int) -> float:
    """Least power of fine detail over the level of light, of all blocks of one plane; inf where none is lit.

    Parameters
    ----------
    photo : LinearPhoto
    channel : int
        Index of the plane.

    Returns
    -------
    float
        A bound for the `shot` of a `NoiseModel` whose `read` is small beside it.
    """
    plane = photo.planes[channel]
    window = np.hanning(_BLOCK)[:, None] * np.hanning(_BLOCK)
    f = fft.fftfreq(_BLOCK)
    radius = np.hypot(f[:, None], f[None, :])
    fine = (radius >= _FINE[0]) & (radius < _FINE[1])
    least = np.inf
    for row in range(0, plane.shape[0] - _BLOCK + 1, _BLOCK // 2):
        for col in range(0, plane.shape[1] - _BLOCK + 1, _BLOCK // 2):
            block = np.asarray(plane[row : row + _BLOCK, col : col + _BLOCK], dtype=np.float64)
            level = float(block.mean())
            if level > _DARK and float(block.max()) < photo.clip[channel]:
                least = min(least, _power(block - level, window, fine) / level)
    return least


def _power(block: NDArray[np.float64], window: NDArray[np.float64], fine: NDArray[np.bool_]) -> float:
    power = np.square(np.abs(fft.fft2(block * window))) / np.square(window).sum()
    return float(power[fine].mean())


def _all_bounded(noise: PlaneNoise, least: Sequence[float]) -> PlaneNoise:
    r, g, b = (_bounded(of_plane, shot) for of_plane, shot in zip(noise, least, strict=True))
    return r, g, b


def _bounded(noise: NoiseModel, shot: float) -> NoiseModel:
    if noise.shot <= shot:
        return noise
    return NoiseModel(shot, noise.read * shot / noise.shot)


def _one_sensitivity(first: LinearPhoto, second: LinearPhoto) -> bool:
    a, b = first.info.metadata, second.info.metadata
    return (a.camera_model, a.iso) == (b.camera_model, b.iso)
