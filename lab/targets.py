"""The printed target as simulated cameras photograph it.

It is drawn `FINE` times finer than pixels and brought to the pixel grid by leaving out the frequencies that
pixels cannot hold. This shares nothing with how `lensmodel.measured` renders its references but the page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Planes
from lensmodel.measured.target import TargetPage

FINE: Final = 3  # drawn samples a pixel along each axis
MARGIN: Final = 28  # pixels around the frame for the lens to blur in: half of the largest kernel


@dataclass(frozen=True, slots=True)
class Setup:
    """How a page or a chart stands before the camera: none of it is ideal."""

    turn_deg: float = 0.7  # rotation
    # perspective: relative change of scale over half the frame, along rows and columns
    keystone: tuple[float, float] = (0.012, -0.018)
    distortion: float = -0.008  # radial, third power: displacement of the corner in half diagonals
    # light lost towards the bottom, the right, and the corners, as shares
    falloff: tuple[float, float, float] = (0.12, 0.08, 0.25)
    gamma: float = 1.15  # tones of the print
    fill: float = 1.0  # height of the page over that of the frame


def target_scene(page: TargetPage, shape: tuple[int, int], setup: Setup) -> Planes:
    """Draw a page that nearly fills a frame of `shape`, with its margin, as linear light 0..1."""
    rows, cols = fine_grid(shape)
    up, right = seen(rows, cols, shape, setup)
    scale = page.shape[0] / (shape[0] * setup.fill)
    places = up * scale + (page.shape[0] - 1) / 2.0, right * scale + (page.shape[1] - 1) / 2.0
    light = np.power(np.clip(0.03 + 0.94 * page.at(*places), 0.0, 1.0), setup.gamma)
    plane = to_pixels(light) * falloff(shape, setup)
    return np.ascontiguousarray(np.broadcast_to(plane.astype(np.float32), (3, *plane.shape)))


def fine_grid(shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places of the drawn samples in pixels from the middle of the frame, down and right."""
    axes = [
        (np.arange((n + 2 * MARGIN) * FINE) / FINE - MARGIN - (n - 1) / 2.0).astype(np.float32) for n in shape
    ]
    rows, cols = np.broadcast_arrays(axes[0][:, None], axes[1][None, :])
    return rows, cols


def seen(
    rows: NDArray[np.float32], cols: NDArray[np.float32], shape: tuple[int, int], setup: Setup
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where on the page a pixel looks, in pixels of a page that stands straight."""
    half = math.hypot(*shape) / 2.0
    bent = (1.0 + setup.distortion * (rows**2 + cols**2) / half**2).astype(np.float32)
    bent_r, bent_c = rows * bent, cols * bent
    angle = math.radians(setup.turn_deg)
    r = bent_r * np.float32(math.cos(angle)) - bent_c * np.float32(math.sin(angle))
    c = bent_r * np.float32(math.sin(angle)) + bent_c * np.float32(math.cos(angle))
    down, right = (np.float32(2.0 * k / n) for k, n in zip(setup.keystone, shape, strict=True))
    below = 1.0 + down * r + right * c
    return np.asarray(r / below, dtype=np.float32), np.asarray(c / below, dtype=np.float32)


def falloff(shape: tuple[int, int], setup: Setup) -> NDArray[np.float32]:
    """Share of the light that reaches each pixel of the frame and its margin."""
    r = np.linspace(-1.0, 1.0, shape[0] + 2 * MARGIN)[:, None]
    c = np.linspace(-1.0, 1.0, shape[1] + 2 * MARGIN)[None, :]
    down, right, corner = setup.falloff
    share = (1.0 - down * (r + 1) / 2) * (1.0 - right * (c + 1) / 2) * (1.0 - corner * (r * r + c * c) / 2)
    return share.astype(np.float32)


def to_pixels(fine: NDArray[np.floating]) -> NDArray[np.float32]:
    """Keep the frequencies that pixels hold, and every `FINE`-th sample."""
    spectrum = fft.rfft2(np.asarray(fine, dtype=np.float32))
    height, width = (n // FINE for n in fine.shape)
    rows = np.abs(fft.fftfreq(fine.shape[0], 1.0 / FINE))[:, None] >= 0.5
    cols = fft.rfftfreq(fine.shape[1], 1.0 / FINE)[None, :] >= 0.5
    spectrum[rows | cols] = 0.0
    plane = fft.irfft2(spectrum, s=fine.shape)[::FINE, ::FINE][:height, :width]
    return np.asarray(np.maximum(plane, 0.0), dtype=np.float32)
