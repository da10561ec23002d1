"""The blind method that the paper compares with, made anew: PSFs constrained to a basis over the whole field.

Source: C. J. Schuler, M. Hirsch, S. Harmeling and B. Schoelkopf, "Blind correction of optical
aberrations", ECCV 2012. All PSFs of a photo are one point in a space of few dimensions: principal
components of the PSF fields of lenses, in a frame that turns with the place. In turn the sharp image
is predicted by bilateral and shock filters, the coefficients are found by least squares over the whole
photo at once, and the image is deconvolved::

    min_c  sum_patches sum_d |d y - (m_p + sum_k c_k(phi) b_kp) * d x|²  +  pull |c|²

Departures from the paper:

1. The basis comes from the simulated lenses of development seeds; theirs from Seidel aberrations of
   lens designs.
2. Coefficients may change with the angle by their first harmonics, which is what decentring does; the
   paper solves sectors of the field apart.
3. Patches with edges instead of the whole image, at full resolution; the paper halved it for memory.
4. The correction is the library's; the paper's is that of Krishnan and Fergus.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lab.blind.steps.gradients import (
    DerivativePair,
    KernelEquations,
    PeriodicPlane,
    across,
    bilateral,
    down,
    inside,
    oriented_threshold,
    shock_filtered,
)
from lab.blind.steps.pyramid import Image, View
from lab.model_benchmark import pixel_to_local
from lensmodel.blind import sampling
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, centred, resized
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings, NoiseModel, Planes
from lensmodel.photo import LinearPhoto
from lensmodel.simulate import draw_lens

STORED: Final = Path(__file__).parent / "data" / "rival_basis.npz"

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RadialBasis:
    """Fields f(r; u, v) = mean + sum_k c_k b_k, on a few radii, linear between them."""

    radii: Floats  # (J,), ascending, from 0 to 1
    mean: Floats  # (J, K, K), in the local frame: columns grow along u, rows against v
    # (m, J, K, K), principal components times their standard deviation, so that a usual lens has c_k around 1
    parts: Floats

    @property
    def side(self) -> int:
        """K."""
        return int(self.mean.shape[-1])

    def turned(self, position: FieldPosition) -> Floats:
        """Mean and components at a place in the image frame, shape (1 + m, K, K)."""
        upper = min(max(int(np.searchsorted(self.radii, position.r)), 1), len(self.radii) - 1)
        low, high = self.radii[upper - 1], self.radii[upper]
        share = min(max((position.r - low) / (high - low), 0.0), 1.0)
        every = np.concatenate([self.mean[None], self.parts])
        local = (1.0 - share) * every[:, upper - 1] + share * every[:, upper]
        half = self.side // 2
        t = np.arange(-half, half + 1, dtype=np.float64)
        u, v = pixel_to_local(t[:, None], t[None, :], position.phi)
        points = np.stack(np.broadcast_arrays(half - v, half + u))
        turn = partial(ndimage.map_coordinates, coordinates=points, order=3, mode="grid-constant")
        return np.stack([turn(one) for one in local])


def principal(fields: NDArray[np.floating], radii: Sequence[float], count: int) -> RadialBasis:
    """Take the principal components of fields."""
    both = np.concatenate([fields, fields[:, :, ::-1]]).astype(np.float64)
    flat = both.reshape(len(both), -1)
    mean = flat.mean(axis=0)
    _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
    scale = sizes[:count] / math.sqrt(len(flat))
    shape = fields.shape[1:]
    parts = (scale[:, None] * directions[:count]).reshape(count, *shape)
    return RadialBasis(np.asarray(radii, dtype=np.float64), mean.reshape(shape), parts)


def save_basis(basis: RadialBasis, path: Path) -> None:
    """Write a basis as npz, each component scaled into half precision."""
    scale = np.abs(basis.parts).max(axis=(1, 2, 3))
    np.savez_compressed(
        path,
        radii=basis.radii,
        mean=basis.mean.astype(np.float32),
        parts=(basis.parts / scale[:, None, None, None]).astype(np.float16),
        scale=scale,
    )


@lru_cache(maxsize=2)
def load_basis(path: Path = STORED) -> RadialBasis:
    """Read what `save_basis` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        parts = stored["parts"].astype(np.float64) * stored["scale"][:, None, None, None]
        return RadialBasis(stored["radii"], stored["mean"].astype(np.float64), parts)


@dataclass(frozen=True, slots=True, eq=False)
class BasisField:
    """A field of the basis; coefficients may change with the angle, c(phi) = c0 + a cos + b sin."""

    basis: RadialBasis
    coefficients: dict[Channel, Floats]  # (m, 3), c0, a, b

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; see `PsfField`."""
        every = self.basis.turned(position)
        return resized(composed(every, self.coefficients[channel] @ harmonics(position.phi)), size)


def harmonics(phi: float) -> Floats:
    """1, cos phi, sin phi."""
    return np.array([1.0, math.cos(phi), math.sin(phi)])


def composed(every: Floats, coefficients: Floats) -> Kernel:
    """Mean plus components; negative values are cut, and the centre of mass moved to the middle."""
    light = np.maximum(every[0] + np.tensordot(coefficients, every[1:], axes=1), 0.0)
    light[light < 1e-3 * light.max()] = 0.0
    return centred(as_kernel(light))


PATCHES = 48
"""Patches looked at in one photo: twice those of a calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoWindow:
    """A window of a photo in all channels."""

    planes: Planes  # (3, side, side)
    noise: tuple[NoiseModel, ...]  # one per channel
    position: FieldPosition  # of its middle


def windows_of(photo: LinearPhoto) -> list[PhotoWindow]:
    """Cut the windows that tell about the blur, chosen in green as a calibration does."""
    return [
        PhotoWindow(photo.planes[:, p.row : p.row + p.size, p.col : p.col + p.size], photo.noise, p.position)
        for p in sampling.find_patches(photo, count=PATCHES).patches
    ]


_ALPHA = 5e-3  # weight of the gradients in the deconvolution, noise has its own beside it (chosen)
_LEAST_WINDOWS = 3  # that determine a field (chosen): as many as a coefficient has terms


@dataclass(frozen=True, slots=True)
class Schuler:
    """Coefficients of a basis of lens PSFs from one photo."""

    basis: RadialBasis | None = None  # none takes the stored one
    rounds: int = 5  # of prediction, least squares and deconvolution
    edges: float = 6.0  # pixels kept in each of four orientations, in sides of the kernel
    pull: float = 0.005  # weight of |c|² as a share of the mean diagonal of the equations
    turning: float = 4.0  # how much more the change with the angle is held back

    def field(self, photo: LinearPhoto) -> BasisField:
        """Estimate the field of all channels from a photo."""
        windows = windows_of(photo)
        if len(windows) < _LEAST_WINDOWS:
            raise NotEnoughEvidenceError(
                f"{len(windows)} patches with edges determine no field; use a photo with more detail"
            )
        basis = self.basis or load_basis()
        turned = [basis.turned(window.position) for window in windows]
        green = self._coefficients(windows, turned, 1, np.zeros((len(basis.parts), 3)))
        found = {
            channel: green if channel == "g" else self._coefficients(windows, turned, i, green)
            for i, channel in enumerate(CHANNELS)
        }
        return BasisField(basis, found)

    def _coefficients(
        self, windows: Sequence[PhotoWindow], turned: Sequence[Floats], channel: int, start: Floats
    ) -> Floats:
        side = turned[0].shape[-1]
        patches = [_Patch.of(window, channel, side) for window in windows]
        found: Floats = start
        for step in range(self.rounds):
            fade = 0.9**step
            total = np.zeros((found.size, found.size))
            right = np.zeros(found.size)
            for patch, window, every in zip(patches, windows, turned, strict=True):
                turn = harmonics(window.position.phi)
                pairs = patch.predicted(composed(every, found @ turn), fade, round(self.edges * side))
                try:
                    normal, target = _projected(KernelEquations.of(pairs, side), every)
                except NotEnoughEvidenceError:
                    continue  # a window without an edge in this colour
                total += np.kron(normal, np.outer(turn, turn))
                right += np.kron(target, turn)
            scale = self.pull * float(np.trace(total)) / found.size
            held = np.tile([1.0, self.turning, self.turning], len(found))
            found = np.asarray(np.linalg.solve(total + np.diag(scale * held), right)).reshape(start.shape)
        return found


def _projected(equations: KernelEquations, every: Floats) -> tuple[Floats, Floats]:
    """Normal equations of the coefficients of the components, the mean taken to the right side."""
    rows, cols = equations.grid
    half = equations.side // 2
    spectra = fft.rfft2(every, equations.grid)
    # the kernel's middle belongs to the origin
    ramp = np.exp(2j * np.pi * half * fft.fftfreq(rows))[:, None] * np.exp(
        2j * np.pi * half * fft.rfftfreq(cols)
    )
    spectra = spectra * ramp
    twice = np.full(cols // 2 + 1, 2.0)  # each column of a half spectrum stands for two
    twice[0] = 1.0
    if cols % 2 == 0:
        twice[-1] = 1.0
    parts = spectra[1:].reshape(len(every) - 1, -1)
    power = (equations.power * twice).ravel()
    rest = ((equations.cross - equations.power * spectra[0]) * twice).ravel()
    normal = ((parts * power) @ parts.conj().T).real
    return normal, (parts.conj() @ rest).real


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """One window of one colour, and its deconvolution by one division of spectra."""

    view: View
    canvas: PeriodicPlane
    spectrum: NDArray[np.complex128]
    slopes: Image

    @classmethod
    def of(cls, window: PhotoWindow, channel: int, side: int) -> _Patch:
        view = View.of(window.planes[channel], window.noise[channel])
        canvas = PeriodicPlane.around(view.y, side)
        row, col = canvas.gradient_power()
        return cls(view, canvas, canvas.spectrum(view.y), row + col)

    def predicted(self, kernel: Kernel, fade: float, least: int) -> list[DerivativePair]:
        """Gradients of the sharp image, guessed where they are strong, beside the observed ones."""
        k = self.canvas.otf(kernel)
        weight = _ALPHA + 4.0 * self.view.noise**2
        x = np.conj(k) * self.spectrum / (np.square(np.abs(k)) + weight * self.slopes)
        latent = self.canvas.cut(fft.irfft2(x, self.canvas.shape))
        smooth = bilateral(latent, reach=2, sigma_space=1.0, sigma_range=0.3 * fade)
        sharp = shock_filtered(smooth, fade)
        row, col = down(sharp), across(sharp)
        margin = inside(row.shape, kernel.shape[0] // 2 + 1)
        strong = np.hypot(row, col) >= oriented_threshold(row, col, least, margin)
        return [
            DerivativePair(np.where(strong, row, 0.0), down(self.view.y), 1.0),
            DerivativePair(np.where(strong, col, 0.0), across(self.view.y), 1.0),
        ]


SEEDS: Final = range(100)  # those of development
RADII: Final = (0.0, 0.25, 0.5, 0.7, 0.85, 1.0)  # half diagonals (chosen): denser outwards
QUARTERS: Final = (0, 1, 2, 3)
"""Directions of the field in quarter turns: only these take a kernel to the local frame exactly."""

SIDE: Final = 31  # pixels of a kernel: that of an estimate
COMPONENTS: Final = 32  # kept in the basis (chosen)
_STOPS: Final = (1.0, math.sqrt(2.0))  # factors on the f-number (chosen): wide open, and one stop closed


def main() -> None:
    """Draw the lenses, take their kernels in the local frame, and store the principal components."""
    argparse.ArgumentParser(description=__doc__).parse_args()  # so that --help writes nothing
    fields = []
    for seed in SEEDS:
        lens = draw_lens(seed)
        for stop in _STOPS:
            settings = LensSettings(aperture=lens.optics[0].f_number * stop, focal_mm=lens.focal_mm[0])
            for quarter in QUARTERS:
                places = [FieldPosition(r, quarter * math.pi / 2.0) for r in RADII]
                kernels = [lens.kernel(place, settings, SIDE) for place in places]
                fields.append([np.rot90(kernel, -quarter) for kernel in kernels])
    save_basis(principal(np.array(fields), RADII, COMPONENTS), STORED)


if __name__ == "__main__":
    main()
