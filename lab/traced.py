"""Lenses whose PSFs are known: drawn ones, and traced ones, PSFs at nodes of the field in a file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.psf import as_kernel, centroid, resized
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.photo.values import LensIdentity
from lensmodel.simulate import SimulatedLens, draw_lens

FORMAT: Final = 1  # raised when files of an older form can no longer be read
_CENTRED_PX: Final = 5e-3  # that a centre of mass may stay off the middle (chosen)


@dataclass(frozen=True, eq=False)
class GridField:
    """The PSF field of a traced lens at one aperture: cubic splines through nodes, clipped at zero."""

    axis: NDArray[np.float64]  # (n,), ascending places of the nodes along both axes, in half diagonals
    # (3, n, n, k, k), Of channels r, g, b; rows of nodes run upwards, columns to the right. Each sums to 1
    # and has its centre of mass on the middle pixel.
    kernels: NDArray[np.float16]
    centers_px: NDArray[np.float32]  # (3, n, n, 2), where they lie against green, (right, up): lateral colour
    facts: Mapping[str, Any]  # design, source, copy, `f_number`, `focal_mm`, `pitch_um`, `half_diagonal_mm`
    _known: dict[tuple[float, float, Channel], Kernel] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        n = self.axis.size
        shapes = (self.kernels.shape[:3], self.centers_px.shape)
        if shapes != ((3, n, n), (3, n, n, 2)) or self.kernels.ndim != 5:
            raise InvalidInputError(f"a grid of {n} nodes a side does not have the shapes {shapes}")

    @property
    def f_number(self) -> float:
        """Aperture of these PSFs."""
        return float(self.facts["f_number"])

    @property
    def pitch_um(self) -> float:
        """Pixel pitch that they were made for."""
        return float(self.facts["pitch_um"])

    @property
    def size(self) -> int:
        """Side of the stored kernels."""
        return int(self.kernels.shape[-1])

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size`; cut or padded from the stored side."""
        h = (position.r * math.cos(position.phi), position.r * math.sin(position.phi))
        return self.kernel_at_field(h, channel, size)

    def kernel_at_field(self, h: tuple[float, float], channel: Channel, size: int) -> Kernel:
        """Kernel at field vector `h` (right, up); beyond the nodes that of the nearest place."""
        key = (h[0], h[1], channel)
        if key not in self._known:
            right, up = self._weights(h)
            nodes = self._nodes[CHANNELS.index(channel)]
            kernel = np.tensordot(right, np.tensordot(up, nodes, axes=(0, 0)), axes=(0, 0))
            self._known[key] = _centred(as_kernel(np.maximum(kernel, 0.0)))
        return resized(self._known[key], size)

    @cached_property
    def lateral(self) -> Mapping[Channel, tuple[float, float]]:
        """Lateral colour against green: outwards c1 r + c3 r^3 pixels, fitted inside the frame."""
        right, up = np.meshgrid(self.axis, self.axis)
        r = np.hypot(right, up)
        inside = (r > 0) & (r <= 1.0)
        found: dict[Channel, tuple[float, float]] = {}
        for channel, centers in zip(CHANNELS, self.centers_px.astype(np.float64), strict=True):
            outwards = (centers[..., 0] * right + centers[..., 1] * up)[inside] / r[inside]
            basis = np.stack([r[inside], r[inside] ** 3], axis=1)
            c1, c3 = np.linalg.lstsq(basis, outwards, rcond=None)[0]
            found[channel] = (float(c1), float(c3))
        return found

    @cached_property
    def _nodes(self) -> NDArray[np.float32]:
        return self.kernels.astype(np.float32)

    @cached_property
    def _basis(self) -> CubicSpline:
        return CubicSpline(self.axis, np.eye(self.axis.size))

    def _weights(self, h: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        inside = np.clip(np.asarray(h, dtype=np.float64), self.axis[0], self.axis[-1])
        right, up = self._basis(inside)
        return right, up

    def write(self, path: str | Path) -> None:
        """Write as npz, whole or not at all."""
        with atomic(Path(path)) as stream:
            facts = np.array(json.dumps(dict(self.facts), sort_keys=True))
            np.savez_compressed(
                stream, format=np.array(FORMAT), axis=self.axis, kernels=self.kernels,
                centers_px=self.centers_px, facts=facts,
            )  # fmt: skip


def read_grid(path: str | Path) -> GridField:
    """Read a grid that `GridField.write` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        if int(stored["format"]) != FORMAT:
            raise InvalidInputError(f"{path} has grid format {stored['format']}, expected {FORMAT}")
        facts = json.loads(str(stored["facts"]))
        return GridField(stored["axis"], stored["kernels"], stored["centers_px"], facts)


@dataclass(frozen=True, eq=False)
class GridLens:
    """A traced lens in front of a simulated camera, at the aperture that it has a grid for."""

    grid: GridField
    serial: str = "TRC0000001"

    @classmethod
    def read(cls, path: str | Path) -> GridLens:
        """Read the grid of a copy."""
        return cls(read_grid(path))

    @property
    def design(self) -> str:
        """Name of the design that it is a copy of."""
        return str(self.grid.facts["design"])

    @property
    def identity(self) -> LensIdentity:
        """As written into the metadata of its photos."""
        model = f"Traced {self.design.title()} {self.focal_mm[0]:.0f}mm f/{self.grid.f_number:g}"
        return LensIdentity("Traced Optics", model, self.serial, "exif")

    @property
    def focal_mm(self) -> tuple[float, ...]:
        """The focal length, rounded to a tenth of a millimetre as lenses tell it."""
        return (round(float(self.grid.facts["focal_mm"]), 1),)

    def f_number(self, settings: LensSettings) -> float:
        """Working f-number of the settings; unknown means its own, and no other is known."""
        own = self.grid.f_number
        if settings.aperture is not None and abs(settings.aperture / own - 1.0) > 0.02:
            raise InvalidInputError(f"this lens has PSFs for f/{own:g}, got f/{settings.aperture:g}")
        return own

    def field(self, settings: LensSettings | None = None) -> GridField:
        """The PSF of every place and channel at these settings."""
        self.f_number(settings or LensSettings())
        return self.grid

    def kernel_at_field(
        self,
        h: tuple[float, float],
        settings: LensSettings,
        size: int,
        *,
        pitch_um: float,
        offset: tuple[float, float] = (0.0, 0.0),
    ) -> Kernel:
        """Kernel at field vector `h`, its centre of mass at `offset` (row, col) pixels."""
        grid = self.field(settings)
        if abs(pitch_um / grid.pitch_um - 1.0) > 1e-3:
            raise InvalidInputError(f"this lens has a pitch of {grid.pitch_um:g} um, got {pitch_um:g} um")
        kernel = grid.kernel_at_field(h, settings.channel, size)
        return kernel if offset == (0.0, 0.0) else _moved(kernel, offset)

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""
        c1, c3 = self.grid.lateral[channel]
        half_diagonal_px = 1000.0 * float(self.grid.facts["half_diagonal_mm"]) / self.grid.pitch_um
        return (c1 * r + c3 * r**3) / half_diagonal_px


@lru_cache(maxsize=16)
def known_lens(seed: int, grid: Path | None = None) -> SimulatedLens | GridLens:
    """Return the lens of third order that a seed draws, or the traced one of a file."""
    return draw_lens(seed) if grid is None else GridLens.read(grid)


def wide_open(lens: SimulatedLens | GridLens) -> LensSettings:
    """Settings of photos with the widest aperture of the shortest focal length."""
    return LensSettings(aperture=lens.f_number(LensSettings()), focal_mm=lens.focal_mm[0])


def _centred(kernel: Kernel) -> Kernel:
    """Undo the shift that clipping the splines' undershoot made."""
    for _ in range(4):
        row, col = centroid(kernel)
        if math.hypot(row, col) < _CENTRED_PX:
            break
        kernel = _moved(kernel, (-row, -col))
    return kernel


def _moved(kernel: Kernel, offset: tuple[float, float]) -> Kernel:
    """Shift by the phase of the spectrum: what the pixel passes below its limit is moved exactly."""
    size = kernel.shape[0]
    grid = int(fft.next_fast_len(size + 2 * math.ceil(max(map(abs, offset)) + 4), real=True))
    rows, cols = fft.fftfreq(grid), fft.rfftfreq(grid)
    phase = np.exp(-2j * np.pi * (rows[:, None] * offset[0] + cols[None, :] * offset[1]))
    padded = np.zeros((grid, grid))
    start = (grid - size) // 2
    padded[start : start + size, start : start + size] = kernel
    moved = fft.irfft2(fft.rfft2(padded) * phase, s=(grid, grid))
    return as_kernel(np.maximum(moved[start : start + size, start : start + size], 0.0))
