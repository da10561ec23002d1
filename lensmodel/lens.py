"""A lens as one value: what it was calibrated from, what it answers; `model.profile` keeps it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.names import full_name
from lensmodel.core.psf import PsfSample, centred
from lensmodel.core.types import Channel, FieldPosition, LensSettings, field_grid
from lensmodel.model import LensModel, PsfAnswer
from lensmodel.model.identity import Identity
from lensmodel.model.profile import LensProfile, read_profile, write_profile
from lensmodel.quality import mtf50_from_kernel, mtf_from_kernel

DEFAULT_SIZE: Final = 55  # pixels (chosen): side of a kernel that a correction uses, so that the same is seen


class Settings(TypedDict, total=False):
    """Settings of the lens that a question may name."""

    aperture: float | None
    focal_mm: float | None
    focus_m: float | None
    channel: Channel


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Lens(LensProfile):
    """One copy of a lens: its PSF at every place of the picture, aperture and color.

    The PSF is the function f(u, v, r, phi, settings) of M. Hirsch and B. Schölkopf, "Self-Calibration of
    Optical Lenses", ICCV 2015, section 6. Places are field positions: `r` is the distance to the centre over
    the half diagonal (0 centre, 1 corner), `phi` the angle in radians, counter-clockwise from the right, in
    sensor orientation. Kernels are float64, of odd side, not negative, of sum 1, on the pixel grid of the
    sensor that the lens was calibrated on.

    Lenses are values: nothing changes one. Make them with `calibrate`, `Lens.from_kernels` or `Lens.load`.
    Places and settings out of their range raise `InvalidInputError`.
    """

    def __repr__(self) -> str:
        return f"<Lens: {self.description}, {len(self.samples)} samples>"

    @classmethod
    def from_kernels(
        cls,
        kernels: ArrayLike,
        r: ArrayLike,
        phi: ArrayLike,
        *,
        aperture: ArrayLike | None = None,
        channel: Channel | Sequence[Channel] = "g",
        weight: ArrayLike = 1.0,
        photo: str | Sequence[str] = "",
        pixel_pitch_um: float | None = None,
    ) -> Lens:
        """Make a PSF field of kernels that were measured in any way, at n places.

        Parameters
        ----------
        kernels : array_like of float, shape (n, k, k)
            k odd; not negative, on the pixel grid of the sensor. Each is normalized, and its centre of mass
            moved to the middle pixel.
        r, phi : array_like of float, shape (n,)
            Field positions: half diagonals 0..1, and radians.
        aperture, channel, weight, photo : array_like of shape (n,) or ()
            Of each kernel, or of all: the f-number, None where it is unknown; "r", "g" or "b"; a confidence
            0..1, which scales its part in answers; what it was measured on, whose faults its kernels share.
        pixel_pitch_um : float, optional
            Pixels of the kernels in micrometres, so that sensors with other pixels may ask.

        Raises
        ------
        InvalidInputError, NoSamplesError
            If a kernel cannot be a PSF, shapes do not fit, or another value is out of its range; or if there
            is no kernel, or none has a weight.
        """
        stack = np.asarray(kernels, dtype=np.float64)
        if stack.ndim != 3:
            raise InvalidInputError(f"kernels must have the shape (n, k, k), got {stack.shape}")
        names = ("r", "phi", "aperture", "channel", "weight", "photo")
        given = (r, phi, aperture, channel, weight, photo)
        columns = [_each(values, len(stack), name) for name, values in zip(names, given, strict=True)]
        common: dict[str, Any] = {"pixel_pitch_um": pixel_pitch_um, "estimator": "given"}
        samples = [
            PsfSample(centred(kernel), FieldPosition(*at), LensSettings(n, channel=c), w, name, **common)
            for kernel, *at, n, c, w, name in zip(stack, *columns, strict=True)
        ]
        return cls(LensModel.fit(samples))

    @classmethod
    def load(cls, path: Path | str) -> Lens:
        """Open a lens profile that `save` or the command wrote; `InvalidInputError` if it is none."""
        known = read_profile(path, Path(path).name)
        return cls(known.model, known.names, known.photos, known.cameras)

    def save(self, path: Path | str) -> None:
        """Write the lens to a file, by custom `*.lensprofile`; it appears complete or not at all.

        A file of that name is replaced. The format is plain JSON and npy in a zip: no pickle, no code.
        """
        with atomic(Path(path)) as file:
            write_profile(file, self)

    def psf(
        self, r: float, phi: float = 0.0, *, size: int = DEFAULT_SIZE, **settings: Unpack[Settings]
    ) -> PsfAnswer:
        """Return the PSF at one place, with how much stands behind it; warns if no photo shows the place.

        `r` is in half diagonals 0..1, `phi` in radians, `size` the odd side of the kernel in pixels. Settings
        are `aperture`, the f-number, where None takes all apertures of the samples together, and so on for
        `focal_mm` in mm and `focus_m` in metres; and `channel`, "r", "g" (default) or "b".
        """
        answer = self.model.query(FieldPosition(r, phi), LensSettings(**settings), size)
        if answer.extrapolated:
            warnings.warn(
                f"no photo shows r = {r:g}, phi = {phi:g} at these settings: the PSF there is a guess, "
                f"expected to be wrong by {answer.predicted_error:.0%}",
                stacklevel=2,
            )
        return answer

    def kernels(
        self, r: ArrayLike, phi: ArrayLike, *, size: int = DEFAULT_SIZE, **settings: Unpack[Settings]
    ) -> NDArray[np.float64]:
        """Return the kernels of `psf` at many places, float64 of shape (*S, size, size).

        `r` and `phi` have shapes that broadcast to one shape S.
        """
        radii, angles = np.asarray(r, dtype=np.float64), np.asarray(phi, dtype=np.float64)
        try:
            radii, angles = np.broadcast_arrays(radii, angles)
        except ValueError as error:
            raise InvalidInputError(
                f"r and phi must have shapes that broadcast, got {radii.shape} and {angles.shape}"
            ) from error
        places = [FieldPosition(*at) for at in zip(radii.flat, angles.flat, strict=True)]
        flat = self.model.kernels(places, LensSettings(**settings), size)
        return flat.reshape(*radii.shape, size, size)

    def mtf(
        self, r: ArrayLike, phi: ArrayLike, frequencies: ArrayLike, **settings: Unpack[Settings]
    ) -> NDArray[np.float64]:
        """Return the contrast that the lens leaves of fine lines (`mtf_from_kernel` gives the equation).

        `r`, `phi` and settings are as of `kernels`, `frequencies` (n,) or () in cycles/pixel, not negative.
        The answer, float64 of shape (2, *S, n), is tangential (contrast along the radius), then sagittal.
        """
        wanted = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
        if wanted.ndim != 1 or not (np.isfinite(wanted) & (wanted >= 0.0)).all():
            raise InvalidInputError(
                f"frequencies must be a flat list of cycles/pixel, finite and not negative, got {wanted}"
            )
        kernels = self.kernels(r, phi, **settings)
        return _both_ways(kernels, phi, lambda kernel, angle: mtf_from_kernel(kernel, angle, wanted))

    def mtf50_map(
        self, rows: int = 20, cols: int = 30, *, aspect: float = 1.5, **settings: Unpack[Settings]
    ) -> NDArray[np.float64]:
        """Return where contrast falls to one half, at the centres of the cells of `field_grid`.

        The answer, float64 of shape (2, rows, cols), is the tangential and sagittal MTF50 in cycles/pixel;
        row 0 is the top in sensor orientation.
        """
        r, phi = field_grid(rows, cols, aspect=aspect)
        return _both_ways(self.kernels(r, phi, **settings), phi, mtf50_from_kernel)

    @property
    def samples(self) -> tuple[PsfSample, ...]:
        """The local PSF estimates that the lens was made of."""
        return self.model.samples

    @property
    def description(self) -> str:
        """Which lens, and how many photos it was learned from."""
        name = full_name(self.names.get("maker"), self.names.get("model"))
        count = len(self.photos)
        return f"{name or 'unknown lens'}, profile of {count} photo{'' if count == 1 else 's'}"

    @property
    def identity(self) -> Identity:
        """What the lens says of itself, to compare with photos."""
        focals = {sample.settings.focal_mm for sample in self.samples}
        return Identity(self.names, self.cameras, [focal for focal in focals if focal])


def _both_ways(
    kernels: NDArray[np.float64], phi: ArrayLike, measure: Callable[[NDArray[np.float64], float], Any]
) -> NDArray[np.float64]:
    """Measure kernels, shape (*S, k, k), along the radius and across it; shape (2, *S, ...)."""
    places = kernels.shape[:-2]
    pairs = list(
        zip(kernels.reshape(-1, *kernels.shape[-2:]), np.broadcast_to(phi, places).flat, strict=True)
    )
    values = np.array([[measure(kernel, at + turn) for kernel, at in pairs] for turn in (0.0, np.pi / 2.0)])
    return values.reshape(2, *places, *values.shape[2:])


def _each(values: ArrayLike | Sequence[str] | None, n: int, name: str) -> list[Any]:
    """Return n numbers or names that were given one by one, or once for all."""
    if values is None:
        return [None] * n
    array = np.asarray(values)
    if array.shape not in {(), (n,)}:
        raise InvalidInputError(f"{name} must be one or {n}, one for each kernel, got {array.shape}")
    plain = array if array.dtype.kind == "U" else np.asarray(values, dtype=np.float64)
    return np.broadcast_to(plain, (n,)).tolist()
