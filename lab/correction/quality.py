"""What every correction method gains on lenses and photographs that nothing was tuned on.

A frame of 6 megapixels is photographed only where it is looked at: a window in the center, one half
way out and one in a corner, where the kernels are those of the whole field. Every window shows the
left half of one photograph and the right half of another.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from lab.images import psnr, ssim
from lab.peers import Peer, read_picture, skimage_results
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, delta
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, NoiseModel, Planes
from lensmodel.correction import SaturationAwareRichardsonLucy, SparseGradient, correct_planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Deconvolver
from lensmodel.quality import slanted_edge
from lensmodel.quality.images import to_srgb
from lensmodel.simulate import load_scene, slanted_edge_scene

EXPOSURES: Final[dict[str, NoiseModel]] = {
    "base ISO": NoiseModel(1 / 50_000, 0.001**2),
    "high ISO": NoiseModel(1 / 2_500, 0.003**2),
}
"""Full well of 50,000 and 2,500 electrons, read noise of 0.1 and 0.3 percent of full scale (chosen)."""

FRAME: Final = Frame(2000, 3000)
WINDOW: Final = (320, 480)  # rows and columns (chosen): a whole frame would take too long
CORNERS: Final[dict[str, tuple[int, int]]] = {"center": (840, 1260), "mid": (340, 660), "corner": (0, 0)}
"""First pixel of each window."""
SWEEP: Final = (0.5, 2.0)
"""Factors on the strength of the prior that are tried against the truth."""
_AROUND, _KERNEL, _NODES, _RIM, _NEAR = 64, 55, 120, 8, 16
"""Pixels around a window that are corrected with it, across a kernel, between kernels, along the rim that
does not count, and beside clipped light that count as near it (chosen)."""

Gains = dict[str, dict[str, tuple[float, float]]]
"""Gain in PSNR (dB) and SSIM by method and zone."""


@dataclass(frozen=True, slots=True)
class Point:
    """A lens without blur: what is left of a correction is its denoising."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return a point, everywhere."""
        return delta(size)


@dataclass(frozen=True, slots=True, eq=False)
class Constant:
    """One kernel everywhere."""

    kernel: Kernel

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel."""
        return self.kernel


@dataclass(frozen=True, slots=True, eq=False)
class FrameWindow:
    """One window of the frame.

    Parameters
    ----------
    zone : str
        Its name.
    top, left : int
        First pixel of what was photographed, in the frame.
    light : Planes
        Blurred light without noise, wider than the window by what the correction looks at.
    scene : Planes
        The sharp light at the same pixels.
    roi : tuple of int
        The window, as `correct_planes` takes it.
    """

    zone: str
    top: int
    left: int
    light: Planes
    scene: Planes
    roi: tuple[int, int, int, int]

    def inner(self, planes: Planes) -> Planes:
        """Cut the window, less a rim, out of planes of what was photographed."""
        top, left = self.roi[0] - self.top + _RIM, self.roi[1] - self.left + _RIM
        return planes[:, top : top + self.roi[2] - 2 * _RIM, left : left + self.roi[3] - 2 * _RIM]


def composed(files: Sequence[Path], gain: float = 1.0) -> Planes:
    """Left half of one photograph and right half of another, as large as a window and all around it."""
    rows, cols = (extent + 2 * (_AROUND + _KERNEL) for extent in WINDOW)
    halves = []
    for path in files:
        scene = load_scene(path)
        wide = cols // len(files)
        top, left = (scene.shape[1] - rows) // 2, (scene.shape[2] - wide) // 2
        halves.append(scene[:, top : top + rows, left : left + wide])
    return np.ascontiguousarray(np.concatenate(halves, axis=2) * np.float32(gain), dtype=np.float32)


def view(zone: str, scene: Planes, field: PsfField) -> FrameWindow:
    """Photograph a window of the frame through a lens."""
    row, col = CORNERS[zone]
    top, left = max(row - _AROUND, 0), max(col - _AROUND, 0)
    height, width = row + WINDOW[0] + _AROUND - top, col + WINDOW[1] + _AROUND - left
    half = _KERNEL // 2
    source = scene[:, : height + 2 * half, : width + 2 * half]
    light = np.zeros((len(CHANNELS), height, width), dtype=np.float32)
    rows, cols = _nodes(height + 2 * half), _nodes(width + 2 * half)
    for c, channel in enumerate(CHANNELS):
        for at_row, weight_row in rows:
            for at_col, weight_col in cols:
                place = FRAME.position(
                    float(np.clip(top - half + at_row, 0, FRAME.height - 1)),
                    float(np.clip(left - half + at_col, 0, FRAME.width - 1)),
                )
                kernel = field.kernel_at(place, channel, _KERNEL).astype(np.float32)
                # The windows act before the blur: a point keeps its light.
                share = source[c] * np.outer(weight_row, weight_col)
                light[c] += signal.oaconvolve(share, kernel, mode="valid").astype(np.float32)
    sharp = np.ascontiguousarray(source[:, half : half + height, half : half + width])
    return FrameWindow(zone, top, left, np.maximum(light, 0.0), sharp, (row, col, *WINDOW))


def _nodes(extent: int) -> list[tuple[float, NDArray[np.float32]]]:
    """Places some 120 pixels apart, and the triangles that share light among them."""
    count = max(2, round(extent / _NODES) + 1)
    places = np.linspace(0, extent - 1, count)
    t = np.arange(extent)
    return [
        (float(p), np.interp(t, places, row).astype(np.float32))
        for p, row in zip(places, np.eye(count), strict=True)
    ]


def exposed(light: Planes, noise: NoiseModel, rng: np.random.Generator) -> Planes:
    """Light on the sensor with noise, clipped at saturation."""
    seen = light + rng.standard_normal(light.shape) * np.sqrt(noise.variance(light))
    return np.minimum(seen, 1.0).astype(np.float32)


def corrected(
    seen: Planes, at: FrameWindow, field: PsfField, noise: NoiseModel, method: str | Deconvolver
) -> Planes:
    """Correct a window as part of its frame; what was not photographed stays black."""
    whole = np.zeros((len(CHANNELS), FRAME.height, FRAME.width), dtype=np.float32)
    whole[:, at.top : at.top + seen.shape[1], at.left : at.left + seen.shape[2]] = seen
    found = correct_planes(whole, field, FRAME, noise=[noise] * 3, method=method, roi=at.roi).planes
    return found[:, _RIM:-_RIM, _RIM:-_RIM]


def our_methods() -> dict[str, str | Deconvolver]:
    """Every method that is compared, by its name in the table."""
    usual = SparseGradient()
    return {
        "standard": "standard",
        "fast": "fast",
        **{f"Richardson-Lucy {n}": SaturationAwareRichardsonLucy(n) for n in (8, 15, 25)},
        **{f"standard, prior x {f:g}": SparseGradient(weight=f * usual.weight) for f in SWEEP},
    }


def gains_of(
    views: Sequence[FrameWindow],
    field: PsfField,
    noise: NoiseModel,
    *,
    methods: Mapping[str, str | Deconvolver],
    peers: Sequence[Peer] = (),
    rng: np.random.Generator,
) -> Gains:
    """Gain of every method and peer in every window of one lens at one exposure.

    Peers are given the best of their settings in each window, chosen against the truth.
    """
    found: Gains = {}
    seen = [exposed(at.light, noise, rng) for at in views]
    tasks = [*((name, field, method) for name, method in methods.items())]
    tasks.append(("denoising only", Point(), SparseGradient()))
    for name, lens, method in tasks:
        found[name] = {
            at.zone: _gain(at.inner(at.scene), at.inner(planes), corrected(planes, at, lens, noise, method))
            for at, planes in zip(views, seen, strict=True)
        }
    for at, planes in zip(views, seen, strict=True):
        for name, pictures in skimage_results(planes).items():
            options = [_gain(at.inner(at.scene), at.inner(planes), at.inner(p)) for p in pictures]
            found.setdefault(name, {})[at.zone] = max(options)
    for peer in peers:
        if peer.installed:
            found[peer.name] = _peer_gains(peer, views, seen)
    return found


def _peer_gains(
    peer: Peer, views: Sequence[FrameWindow], seen: Sequence[Planes]
) -> dict[str, tuple[float, float]]:
    """Best gain of a program in each window; all windows stand in one picture.

    A program that develops a mosaic is measured against its own development of the sharp scene.
    """
    high, wide = (max(planes.shape[axis] for planes in seen) for axis in (1, 2))

    def stacked(pictures: Sequence[Planes]) -> NDArray[np.float32]:
        """Windows below each other, in sRGB, `(rows, cols, 3)`."""
        padded = [
            np.pad(p, ((0, 0), (0, high - p.shape[1]), (0, wide - p.shape[2])), mode="symmetric")
            for p in pictures
        ]
        return np.moveaxis(to_srgb(np.concatenate(padded, axis=1)), 0, -1).astype(np.float32)

    def run(pictures: Sequence[Planes], setting: float) -> list[Planes]:
        with tempfile.TemporaryDirectory() as name:
            source = Path(name) / ("in.dng" if peer.raw else "in.tif")
            peer.write_input(stacked(pictures), source)
            made = np.moveaxis(read_picture(peer.run(source, Path(name), setting)[0]), -1, 0)
        lost = (high * len(views) - made.shape[1]) // 2, (wide - made.shape[2]) // 2
        made = np.pad(made, ((0, 0), (lost[0],) * 2, (lost[1],) * 2), mode="edge")
        return [
            at.inner(made[:, i * high : i * high + p.shape[1], : p.shape[2]])
            for i, (at, p) in enumerate(zip(views, pictures, strict=True))
        ]

    truths = run([at.scene for at in views], 0.0) if peer.raw else None
    plain = run(seen, 0.0)
    best: dict[str, tuple[float, float]] = {}
    for setting in peer.settings:
        for i, (at, after) in enumerate(zip(views, run(seen, setting), strict=True)):
            truth = to_srgb(at.inner(at.scene)).astype(np.float32) if truths is None else truths[i]
            gain = psnr(after, truth) - psnr(plain[i], truth), ssim(after, truth) - ssim(plain[i], truth)
            best[at.zone] = max(best.get(at.zone, gain), gain)
    return best


def _gain(truth: Planes, before: Planes, after: Planes) -> tuple[float, float]:
    """Gain in PSNR and in SSIM of the sRGB picture."""
    return (
        psnr(after, truth, srgb=True) - psnr(before, truth, srgb=True),
        ssim(after, truth, srgb=True) - ssim(before, truth, srgb=True),
    )


def lamp_gains(
    at: FrameWindow, field: PsfField, noise: NoiseModel, methods: Mapping[str, str | Deconvolver]
) -> dict[str, float]:
    """Gain in PSNR of the pixels near clipped ones; shape of the scene beyond saturation plays no part."""
    seen = exposed(at.light, noise, np.random.default_rng(11))
    clipped = (seen >= 1.0).any(axis=0)
    near = (ndimage.distance_transform_edt(~clipped) <= _NEAR) & ~clipped & (at.scene < 1.0).all(axis=0)
    mask = at.inner(near[None])[0]
    before = psnr(at.inner(seen), at.inner(at.scene), mask=mask, srgb=True)
    return {
        name: psnr(corrected(seen, at, field, noise, method), at.inner(at.scene), mask=mask, srgb=True)
        - before
        for name, method in methods.items()
    }


@dataclass(frozen=True, slots=True)
class EdgeFigures:
    """A slanted edge of green before and after, and what is left of the noise of a flat.

    Parameters
    ----------
    before, after : float
        MTF50, cycles per pixel.
    overshoot : float
        Percent of the step.
    noise : float
        Noise after over noise before in a flat.
    """

    before: float
    after: float
    overshoot: float
    noise: float


def edge_figures(field: PsfField, noise: NoiseModel, r: float, method: str = "standard") -> EdgeFigures:
    """Correct a chart and a flat blurred by the kernel at radius r."""
    kernel = field.kernel_at(FieldPosition(r, 0.6), "g", _KERNEL)
    blur = UniformBlur(kernel)
    frame = Frame(240, 240)
    rng = np.random.default_rng(5)

    def fixed(scene: NDArray[np.float32], cut: Callable[[Planes], Planes]) -> tuple[Planes, Planes]:
        seen = exposed(np.stack([blur.forward(scene)] * 3), noise, rng)
        after = correct_planes(seen, Constant(kernel), frame, noise=[noise] * 3, method=method).planes
        return cut(seen), cut(after)

    side = 240 + 2 * blur.reach
    edge = slanted_edge_scene(side, side, 0.15, dark=0.15, bright=0.75)
    before, after = (
        slanted_edge(planes[1]) for planes in fixed(edge, lambda planes: planes[:, 60:180, 60:180])
    )
    flat = np.full((side, side), 0.3, dtype=np.float32)
    noisy, calm = fixed(flat, lambda planes: planes[:, 40:200, 40:200])
    return EdgeFigures(before.mtf50, after.mtf50, after.overshoot, float(calm.std() / noisy.std()))
