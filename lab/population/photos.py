"""Photos of scenes through a lens of the population, as patches: blur, what spoils it, the camera, the file.

Per patch a crop of a scene is blurred by the kernel of its place, with lateral colour, and where the photo
has parts out of focus or was shaken, by a disc or a line as well; sampled by a Bayer mosaic with shot and
read noise and clipping. A file of the kind "tiff" or "jpeg" is to be corrected for the lens together with its
processing: `Processing.applied` gives that kernel.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray
from PIL import Image
from scipy.special import j1

from lab.images import to_srgb
from lab.population.scenes import busiest
from lensmodel.core.psf import PatchKind
from lensmodel.neural.network import FINE, LENGTH, SIDE, WINDOW, patch_statistics
from lensmodel.photo.colour import srgb_to_linear

_MARGIN: Final = 8  # pixels around a window that demosaicking and sharpening look at
_CLIPPED: Final = 0.02  # largest share of clipped samples of a patch that is used
_SOFTEST: Final = 2.8  # slope of the spectrum beyond which a photograph is out of focus (chosen)
_OWN_BLUR: Final = 0.35  # px^2 of a scene's own blur that are undone at most (chosen)
_DEVELOPED_READ: Final = 1e-3  # noise that the statistics expect of developed files: their own is coloured


class Scenes:
    """Crops of the scenes in a folder that `scenes.build` wrote; read from disk by need."""

    def __init__(self, folder: Path, *, held_out: bool) -> None:
        index = json.loads((folder / "index.json").read_text(encoding="utf-8"))
        names = sorted({entry["name"] for entry in index})
        apart = set(names[4::10])
        chosen = [
            entry
            for entry in index
            if (entry["name"] in apart) == held_out
            and (entry["slope"] < _SOFTEST or entry["name"].startswith(("leaves", "text")))
        ]
        self._scenes = [np.load(folder / entry["file"], mmap_mode="r") for entry in chosen]
        # variance of each scene's own blur, px^2, which a photo of it undoes
        self.blur = tuple(min(float(entry["blur"]), _OWN_BLUR) for entry in chosen)

    def __len__(self) -> int:
        return len(self._scenes)

    def crop(self, number: int, side: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Cut a square (3, side, side), mostly the busiest of three, and turn it at random."""
        crop = busiest(self._scenes[number], side, rng, 3 if rng.random() < 0.8 else 1)
        crop = crop.astype(np.float32).transpose(2, 0, 1)
        turn = int(rng.integers(8))
        crop = np.rot90(crop, turn % 4, (1, 2))
        return np.ascontiguousarray(crop[:, :, ::-1] if turn > 3 else crop)


@dataclass(frozen=True, slots=True)
class Processing:
    """What a converter or camera does to a developed picture."""

    smoothing: float  # standard deviation of luma noise reduction, pixels
    chroma_smoothing: float  # the same of chroma
    amount: float  # unsharp mask
    radius: float
    contrast: float  # strength of an S curve on top of the gamma of sRGB
    quality: int  # of JPEG; 0 is 16-bit TIFF
    # false for pictures that the camera has scaled down: all colours are known at every pixel
    mosaicked: bool

    @classmethod
    def draw(cls, rng: np.random.Generator, kind: PatchKind) -> Processing:
        """Draw what converters ("tiff") or cameras ("jpeg") do."""
        if kind == "tiff":
            return cls(
                rng.choice([0.0, rng.uniform(0, 0.5)]), rng.uniform(0, 1.0),
                rng.choice([0.0, rng.uniform(0, 0.6)]), rng.uniform(0.5, 1.5), 0.0, 0, mosaicked=True,
            )  # fmt: skip
        return cls(
            rng.uniform(0, 0.6), rng.uniform(0.5, 2.0), (rng.random() > 0.15) * rng.uniform(0.15, 1.2),
            rng.uniform(0.5, 1.5), rng.uniform(0, 0.8), int(rng.integers(70, 99)),
            mosaicked=rng.random() < 0.7,
        )  # fmt: skip

    def applied(self, kernels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Kernels (..., n, n) of the lens together with smoothing and sharpening, halos cut, sum 1."""
        changed = np.maximum(self._sharpened(kernels), 0.0)
        return changed / changed.sum((-1, -2), keepdims=True)

    def _sharpened(self, luma: NDArray[np.float32]) -> NDArray[np.float32]:
        """Smooth and sharpen planes (..., rows, cols)."""
        flat = (0.0,) * (luma.ndim - 2)
        if self.smoothing:
            luma = scipy.ndimage.gaussian_filter(luma, (*flat, self.smoothing, self.smoothing))
        if self.amount:
            luma = luma + self.amount * (
                luma - scipy.ndimage.gaussian_filter(luma, (*flat, self.radius, self.radius))
            )
        return luma

    def develop(self, mosaic: NDArray[np.float32], planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return linear planes (3, n, n) as read back from the file; `planes` where it was scaled down."""
        rgb = demosaic(mosaic) if self.mosaicked else planes
        v = to_srgb(rgb).astype(np.float32)
        if self.contrast:
            v = v + self.contrast * v * (1 - v) * (v - 0.45)
        luma = np.tensordot(_LUMA, v, 1)
        chroma = v - luma
        if self.chroma_smoothing:
            chroma = scipy.ndimage.gaussian_filter(chroma, (0, self.chroma_smoothing, self.chroma_smoothing))
        luma = self._sharpened(luma)
        v = np.clip(luma + chroma, 0.0, 1.0)
        if not self.quality:
            return srgb_to_linear(v).astype(np.float32)
        data, eight = io.BytesIO(), (v.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)
        Image.fromarray(eight).save(data, "JPEG", quality=self.quality, subsampling="4:2:0")
        with Image.open(data) as picture:
            return srgb_to_linear(np.asarray(picture).transpose(2, 0, 1) / 255.0).astype(np.float32)


_LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@cache
def bayer(rows: int, cols: int, phase: int = 0) -> NDArray[np.int8]:
    """Colours of a Bayer mosaic, 0 red, 1 green, 2 blue; the phase 0..3 says where red is."""
    cell = np.array([[0, 1], [1, 2]], np.int8)
    cell = np.roll(cell, (phase // 2, phase % 2), (0, 1))
    return np.tile(cell, (rows // 2 + 1, cols // 2 + 1))[:rows, :cols]


_CROSS: Final = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]], np.float32
) / 8  # fmt: skip
_ALONG: Final = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]],
    np.float32,
) / 8  # fmt: skip
_OTHER: Final = np.array(
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]],
    np.float32,
) / 8  # fmt: skip


def demosaic(mosaic: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate a mosaic with red in its first corner linearly (H. S. Malvar et al., ICASSP 2004)."""
    colours = bayer(*mosaic.shape)
    cross, along, across, other = (
        scipy.ndimage.correlate(mosaic, kernel, mode="mirror")
        for kernel in (_CROSS, _ALONG, _ALONG.T, _OTHER)
    )
    even = (np.arange(mosaic.shape[0]) % 2 == 0)[:, None]
    green = np.where(colours == 1, mosaic, cross)
    red = np.select([colours == 0, colours == 2, even], [mosaic, other, along], across)
    blue = np.select([colours == 2, colours == 0, even], [mosaic, other, across], along)
    return np.stack([red, green, blue]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class _Exposure:
    """What all patches of one photo share."""

    gain: float
    read: float
    shot: float
    sources: tuple[int, ...]  # a scene for each quarter of the frame
    tilts: tuple[tuple[float, float], ...]  # change of each scene's spectrum: slope, variance of blur in px^2
    focus_error: float  # radius of a disc in pixels, 0: in focus
    focus_normal: tuple[float, float, float]  # half plane of the frame that is out of focus: nx, ny, offset
    shake: tuple[float, float]  # vector of a line, pixels


@dataclass
class Camera:
    """One body with one lens: its colours, lateral colour and processing; takes patches of photos."""

    rng: np.random.Generator
    scenes: Scenes
    kind: PatchKind
    xy: NDArray[np.float64]  # (places, 2)
    kernels: NDArray[np.float32]  # (states, places, 3, SIDE, SIDE), of the lens alone
    plain: bool = False  # base sensitivity, all in focus and still: what the best photos are like
    processing: Processing | None = field(init=False)

    def __post_init__(self) -> None:
        rng = self.rng
        self.processing = None if self.kind == "raw" else Processing.draw(rng, self.kind)
        self._balance = (
            np.array([rng.uniform(0.4, 1), 1, rng.uniform(0.4, 1)]) if rng.random() < 0.5 else np.ones(3)
        )
        self._mix = np.eye(3)
        if rng.random() < 0.5:
            self._mix = np.eye(3) + rng.uniform(0, 0.3, (3, 3)) * (1 - np.eye(3))
            self._mix /= self._mix.sum(1, keepdims=True)
        if self.kind == "jpeg":
            self._balance = np.ones(3)
        self._lateral = rng.normal(0, 0.6, 2) * (1 if rng.random() < 0.8 else 2.5)
        self._offset = rng.normal(0, 0.1, (2, 2))
        # 0 base sensitivity, 1 the highest
        self._noise = rng.uniform(0, 1) if rng.random() < 0.6 and not self.plain else 0.0
        self._window = WINDOW + (0 if self.kind == "raw" else 2 * _MARGIN)
        outside = 1.0 - self.kernels[..., 21:-21, 21:-21].sum((-1, -2)).min()
        self._reach = (FINE if outside < 2e-3 else SIDE) // 2
        self._side = scipy.fft.next_fast_len(self._window + 2 * self._reach, real=True)
        fx, fy = scipy.fft.rfftfreq(self._side)[None], scipy.fft.fftfreq(self._side)[:, None]
        self._fx, self._fy, self._f = (f.astype(np.float32) for f in (fx, fy, np.hypot(fx, fy)))
        self._otfs: dict[tuple[int, int], NDArray[np.complex64]] = {}

    def _expose(self) -> _Exposure:
        rng = self.rng
        one = rng.random() < 0.35
        drawn = rng.integers(0, len(self.scenes), 1 if one else 4)
        sources = tuple(int(s) for s in (np.repeat(drawn, 4) if one else drawn))
        tilts = tuple(
            (float(rng.normal(0, 0.15)), float(rng.normal(0, 0.3)) ** 2 - self.scenes.blur[s])
            for s in sources
        )
        # 45,000 down to 800
        electrons = np.exp(np.log(45_000) - self._noise * np.log(56) + rng.normal(0, 0.3))
        error, normal, shake = 0.0, (0.0, 0.0, 1.0), (0.0, 0.0)
        lot = 1.0 if self.plain else rng.random()
        if lot < 0.25:
            error = float(np.exp(rng.uniform(np.log(0.5), np.log(7.0))))
            t = rng.uniform(0, 2 * np.pi)
            offset = float(rng.uniform(-0.9, 0.7)) if lot < 0.19 else -9.0
            normal = float(np.cos(t)), float(np.sin(t)), offset
        elif lot < 0.35:
            length, t = np.exp(rng.uniform(np.log(0.7), np.log(7.0))), rng.uniform(0, np.pi)
            shake = (float(length * np.cos(t)), float(length * np.sin(t)))
        return _Exposure(
            gain=float(np.exp(rng.normal(-0.1, 0.35))),
            read=float(rng.uniform(1.5, 6.0) / electrons + 1.5e-4),
            shot=float(1.0 / electrons),
            sources=sources, tilts=tilts, focus_error=error, focus_normal=normal, shake=shake,
        )  # fmt: skip

    def take(self, photos: int, patches: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Take some photos: statistics (n, LENGTH) of patches, and (n, 3) place, photo and state of each."""
        rng = self.rng
        states, places = self.kernels.shape[:2]
        counts = rng.multinomial(patches, np.ones(photos) / photos)
        statistics, of = [], []
        for photo, count in enumerate(counts):
            exposure, state = self._expose(), int(rng.integers(states))
            for place in rng.integers(0, places, count):
                made = self._patch(exposure, state, int(place))
                if made is not None:
                    statistics.append(made)
                    of.append((int(place), photo, state))
        return np.array(statistics, np.float32).reshape(-1, LENGTH), np.array(of, int).reshape(-1, 3)

    def _otf(self, state: int, place: int) -> NDArray[np.complex64]:
        """Transfer functions of one place, with lateral colour; kept while there is room."""
        key = (state, place)
        if key not in self._otfs:
            kernel = self.kernels[state, place]
            middle = slice(SIDE // 2 - self._reach, SIDE // 2 + self._reach + 1)
            inner = kernel[:, middle, middle]
            padded = np.zeros((3, self._side, self._side), np.float32)
            padded[:, : inner.shape[1], : inner.shape[2]] = inner / inner.sum((1, 2), keepdims=True)
            otf = scipy.fft.rfft2(np.roll(padded, (-self._reach, -self._reach), (1, 2)))
            r = np.hypot(*self.xy[place])
            for k, colour in enumerate((0, 2)):
                dx, dy = self._lateral[k] * self.xy[place] * (1 if r > 0 else 0) + self._offset[k]
                otf[colour] *= np.exp(-2j * np.pi * (self._fx * dx - self._fy * dy))
            self._otfs[key] = otf
        return self._otfs[key]

    def _patch(self, exposure: _Exposure, state: int, place: int) -> NDArray[np.float32] | None:
        """Statistics of one patch, or None where too much of it is clipped."""
        rng = self.rng
        x, y = (float(v) for v in self.xy[place])
        quarter = int(x > 0) + 2 * int(y > 0)
        crop = self.scenes.crop(exposure.sources[quarter], self._side, rng)
        gains = exposure.gain * self._balance
        crop = np.tensordot((self._mix * gains[:, None]).astype(np.float32), crop, 1)
        change = self._otf(state, place)
        slope, blur = exposure.tilts[quarter]
        tilt = (1.0 + self._f / 0.05) ** slope * np.exp(-2 * np.pi**2 * blur * np.minimum(self._f, 0.5) ** 2)
        change = change * tilt
        nx, ny, offset = exposure.focus_normal
        if exposure.focus_error and nx * x + ny * y > offset:
            change = change * _disc(self._f * exposure.focus_error)
        if exposure.shake != (0.0, 0.0):
            change = change * np.sinc(self._fx * exposure.shake[0] - self._fy * exposure.shake[1])
        blurred = scipy.fft.irfft2(scipy.fft.rfft2(crop) * change.astype(np.complex64), s=(self._side,) * 2)
        inside = slice(self._reach, self._reach + self._window)
        planes = np.maximum(blurred[:, inside, inside], 0.0)
        phase = int(rng.integers(4)) if self.kind == "raw" else 0
        colours = bayer(self._window, self._window, phase)
        mosaic = np.take_along_axis(planes, colours[None].astype(np.intp), 0)[0]
        sigma = np.sqrt(exposure.read**2 + exposure.shot * mosaic)
        noisy = mosaic + sigma * rng.standard_normal(mosaic.shape, np.float32)
        mosaic = np.minimum(noisy, 1.0).astype(np.float32)
        if (mosaic >= 0.995).mean() > _CLIPPED:
            return None
        if self.processing is None:
            told = np.exp(rng.normal(0, 0.1, 2))  # noise models of cameras are not exact
            return patch_statistics(mosaic, colours, exposure.read * told[0], exposure.shot * told[1])
        planes = np.minimum(planes + 0.7 * sigma * rng.standard_normal(planes.shape, np.float32), 1.0)
        developed = self.processing.develop(mosaic, planes)
        inner = slice(_MARGIN, _MARGIN + WINDOW)
        colours = bayer(WINDOW, WINDOW)
        sampled = np.take_along_axis(developed[:, inner, inner], colours[None].astype(np.intp), 0)[0]
        return patch_statistics(np.ascontiguousarray(sampled), colours, _DEVELOPED_READ, 0.0)


def _disc(cycles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transfer function of a uniform disc: frequency times radius in, 2 J1(2 pi x) / (2 pi x) out."""
    z = 2 * np.pi * np.maximum(cycles, 1e-6)
    return (2 * j1(z) / z).astype(np.float32)
