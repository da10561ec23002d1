"""Blind correction constrained to a basis of lens PSFs, `schuler`.

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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft

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
from lab.rivals.basis import BasisField, RadialBasis, composed, harmonics, load_basis
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import CHANNELS, FieldPosition, Kernel, NoiseModel, Plane, Planes
from lensmodel.photo import LinearPhoto
from lensmodel.workflow import sampling

PATCHES = 48
"""Patches looked at in one photo: twice those of a calibration, because rivals are cheap."""


class Rival(Protocol):
    """A blind method of somebody else: photos of one lens at one setting in, its PSF field out."""

    name: str
    source: str

    def field(self, photos: Sequence[LinearPhoto]) -> PsfField:
        """Estimate the PSF field, all channels."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoWindow:
    """A window of a photo in all channels."""

    planes: Planes  # (3, side, side)
    noise: tuple[NoiseModel, ...]  # one per channel
    position: FieldPosition  # of its middle

    def plane(self, channel: int) -> Plane:
        """One colour of it."""
        return self.planes[channel]


def windows_of(photos: Sequence[LinearPhoto]) -> list[PhotoWindow]:
    """Cut the windows that tell about the blur, chosen in green as a calibration does."""
    found = []
    for photo in photos:
        for patch in sampling.find_patches(photo, count=PATCHES).patches:
            rows, cols = slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size)
            planes = np.ascontiguousarray(photo.planes[:, rows, cols])
            found.append(PhotoWindow(planes, photo.noise, patch.position))
    return found


_ALPHA = 5e-3  # weight of the gradients in the deconvolution, noise has its own beside it (chosen)
_LEAST_WINDOWS = 3  # that determine a field (chosen): as many as a coefficient has terms

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Schuler:
    """Coefficients of a basis of lens PSFs from one photo."""

    basis: RadialBasis | None = None  # none takes the stored one
    rounds: int = 5  # of prediction, least squares and deconvolution
    edges: float = 6.0  # pixels kept in each of four orientations, in sides of the kernel
    pull: float = 0.005  # weight of |c|² as a share of the mean diagonal of the equations
    turning: float = 4.0  # how much more the change with the angle is held back

    name = "schuler"
    source = "Schuler et al. 2012 (one photo, PSFs constrained to principal components of lenses)"

    def field(self, photos: Sequence[LinearPhoto]) -> BasisField:
        """Estimate the field; see `Rival`."""
        windows = windows_of(photos)
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
        view = View.of(window.plane(channel), window.noise[channel])
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
