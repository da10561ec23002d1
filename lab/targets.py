"""What simulated cameras photograph to measure a lens: targets, charts, lights, and a scene twice.

Everything is drawn `FINE` times finer than pixels and brought to the pixel grid by leaving out the
frequencies that pixels cannot hold: the kernels of simulated lenses are known on the pixel grid only.
This shares nothing with how `lensmodel.measured` renders its references but the page itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.types import Planes
from lensmodel.measured.page import TargetPage

FINE: Final = 3
"""Drawn samples a pixel along each axis."""

MARGIN: Final = 28
"""Pixels around the frame for the lens to blur in: half of the largest kernel."""


SKY: Final = 0.003
"""Light between points: a night sky over a suburb takes so much of a full well where stars do not clip."""


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
    rows, cols = _fine_grid(shape)
    up, right = _seen(rows, cols, shape, setup)
    scale = page.shape[0] / (shape[0] * setup.fill)
    places = (
        up * scale + (page.shape[0] - 1) / 2.0,
        right * scale + (page.shape[1] - 1) / 2.0,
    )
    light = np.power(np.clip(0.03 + 0.94 * page.at(*places), 0.0, 1.0), setup.gamma)
    plane = _to_pixels(light) * _falloff(shape, setup)
    return np.ascontiguousarray(np.broadcast_to(plane.astype(np.float32), (3, *plane.shape)))


def board_scene(square_px: float, shape: tuple[int, int], setup: Setup) -> Planes:
    """Draw a checkerboard, turned by five degrees more than the setup says, as slanted charts are."""
    rows, cols = _fine_grid(shape)
    up, right = _seen(rows, cols, shape, setup)
    angle = math.radians(5.0)
    a = (up * math.cos(angle) - right * math.sin(angle)) / square_px
    b = (up * math.sin(angle) + right * math.cos(angle)) / square_px
    dark = (np.floor(a) + np.floor(b)) % 2 > 0
    light = np.where(dark, np.float32(0.12), np.float32(0.8))
    plane = np.maximum(_to_pixels(light), 0.0) * _falloff(shape, setup)
    return np.ascontiguousarray(np.broadcast_to(plane.astype(np.float32), (3, *plane.shape)))


def light_scene(
    spacing: int, shape: tuple[int, int], rng: np.random.Generator, *, faint: float = 0.25
) -> Planes:
    """Draw points of light anywhere between pixels, of different brightness, over a dark sky.

    A point between pixels is the sinc that a point is to whoever sees no finer than pixels. Its lobes are
    negative here and gone behind a lens.
    """
    height, width = (n + 2 * MARGIN for n in shape)
    plane = np.zeros((height, width))
    step_r = np.arange(MARGIN + spacing // 2, height - MARGIN - spacing // 4, spacing)
    step_c = np.arange(MARGIN + spacing // 2, width - MARGIN - spacing // 4, spacing)
    for row in step_r:
        for col in step_c:
            r, c = np.array([row, col]) + rng.uniform(-0.15, 0.15, 2) * spacing
            flux = faint * 10.0 ** rng.uniform(0.0, 0.7)
            reach = 24
            top, left = round(r) - reach, round(c) - reach
            t = np.arange(2 * reach + 1)
            taper = np.cos(np.linspace(-np.pi / 2, np.pi / 2, 2 * reach + 1)) ** 0.5
            lobe_r, lobe_c = np.sinc(t + top - r) * taper, np.sinc(t + left - c) * taper
            plane[top : top + 2 * reach + 1, left : left + 2 * reach + 1] += flux * np.outer(lobe_r, lobe_c)
    plane += SKY
    return np.ascontiguousarray(np.broadcast_to(plane.astype(np.float32), (3, *plane.shape)))


def moved_scene(scene: Planes, shift: tuple[float, float], turn_deg: float) -> Planes:
    """What a tripod that gave way a little shows of a scene: moved by parts of a pixel, and turned."""
    angle = math.radians(turn_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = (np.array(scene.shape[1:]) - 1.0) / 2.0
    start = middle - turn @ (middle + np.array(shift))
    planes = [
        ndimage.affine_transform(plane, turn, start, order=5, mode="mirror", output=np.float32)
        for plane in scene
    ]
    return np.ascontiguousarray(np.maximum(np.stack(planes), 0.0))


def _fine_grid(shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places of the drawn samples in pixels from the middle of the frame, down and right."""
    axes = [
        (np.arange((n + 2 * MARGIN) * FINE) / FINE - MARGIN - (n - 1) / 2.0).astype(np.float32) for n in shape
    ]
    rows, cols = np.broadcast_arrays(axes[0][:, None], axes[1][None, :])
    return rows, cols


def _seen(
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


def _falloff(shape: tuple[int, int], setup: Setup) -> NDArray[np.float32]:
    r = np.linspace(-1.0, 1.0, shape[0] + 2 * MARGIN)[:, None]
    c = np.linspace(-1.0, 1.0, shape[1] + 2 * MARGIN)[None, :]
    down, right, corner = setup.falloff
    return (
        (1.0 - down * (r + 1) / 2) * (1.0 - right * (c + 1) / 2) * (1.0 - corner * (r * r + c * c) / 2)
    ).astype(np.float32)


def _to_pixels(fine: NDArray[np.floating]) -> NDArray[np.float32]:
    """Keep the frequencies that pixels hold, and every `FINE`-th sample."""
    spectrum = fft.rfft2(np.asarray(fine, dtype=np.float32))
    height, width = (n // FINE for n in fine.shape)
    rows = np.abs(fft.fftfreq(fine.shape[0], 1.0 / FINE))[:, None] >= 0.5
    cols = fft.rfftfreq(fine.shape[1], 1.0 / FINE)[None, :] >= 0.5
    spectrum[rows | cols] = 0.0
    plane = fft.irfft2(spectrum, s=fine.shape)[::FINE, ::FINE][:height, :width]
    return np.asarray(np.maximum(plane, 0.0), dtype=np.float32)
