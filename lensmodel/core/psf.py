"""A PSF as an array: normalise, centre, measure, compare; and the sample that travels."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Literal, Protocol, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded when they are needed: processes that compute nothing do not wait

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings

WING_LEVEL = 0.01
"""Moments count values above this share of the peak: the width of faint wings is not the width."""

PatchKind: TypeAlias = Literal["raw", "tiff", "jpeg"]
"""How the pixels of a patch were made: by the sensor alone, by a raw converter, by a camera."""

_CENTRED_PX = 1e-3  # pixels: a thousandth moves no figure that is reported


def as_kernel(values: npt.ArrayLike) -> Kernel:
    """Check and normalise an array to a kernel of sum 1, read-only, not yet centred."""
    kernel = np.array(values, dtype=np.float64)  # a copy of our own, never the caller's
    if kernel.ndim != 2 or kernel.shape[0] != kernel.shape[1] or kernel.shape[0] % 2 == 0:
        raise InvalidInputError(f"kernel must be square with an odd side, got shape {kernel.shape}")
    if not np.isfinite(kernel).all() or kernel.min() < 0 or kernel.sum() <= 0:
        raise InvalidInputError("kernel must be finite, non-negative and not all zero")
    kernel /= kernel.sum()
    kernel.setflags(write=False)
    return kernel


def delta(size: int) -> Kernel:
    """Kernel of side `size` that changes nothing."""
    kernel = np.zeros((size, size))
    kernel[size // 2, size // 2] = 1.0
    return as_kernel(kernel)


def resized(kernel: Kernel, size: int) -> Kernel:
    """Crop or zero-pad to another odd side, centre kept, renormalised."""
    if size < 1 or size % 2 == 0:
        raise InvalidInputError(f"size must be odd and positive, got {size}")
    cut = (kernel.shape[0] - size) // 2
    return as_kernel(kernel[cut : cut + size, cut : cut + size] if cut >= 0 else np.pad(kernel, -cut))


def support_radius(kernel: Kernel, energy: float = 0.999) -> int:
    """Half side, in pixels, of the centred square that holds a share `energy` of the kernel's sum."""
    middle = kernel.shape[0] // 2
    t = np.abs(np.arange(kernel.shape[0]) - middle)
    ring = np.maximum(t[:, None], t[None, :])
    held = np.cumsum(np.bincount(ring.ravel(), weights=kernel.ravel()))
    return int(np.searchsorted(held, energy * held[-1]))


def crop_to_support(kernel: Kernel, energy: float = 0.999) -> Kernel:
    """Cut a kernel to what holds a share `energy` of its sum; the sum is 1 again."""
    return resized(kernel, 2 * support_radius(kernel, energy) + 1)


def centroid(kernel: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Centre of mass `(row, col)` relative to the middle pixel, in pixels."""
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    total = kernel.sum()
    return float((kernel.sum(axis=1) * t).sum() / total), float((kernel.sum(axis=0) * t).sum() / total)


def centred(kernel: npt.ArrayLike) -> Kernel:
    """Shift the centre of mass onto the middle pixel: by whole pixels first, the rest by cubic splines."""
    current = np.array(as_kernel(kernel))
    for _ in range(12):  # clipping the spline's undershoot moves the centre a little
        row, col = centroid(current)
        if max(abs(row), abs(col)) < _CENTRED_PX:
            break
        whole = (-round(row), -round(col))
        order = 1 if whole != (0, 0) else 3
        step = whole if whole != (0, 0) else (-row, -col)
        current = scipy.ndimage.shift(current, step, order=order, mode="constant")
        current = np.maximum(current, 0.0)
        current /= current.sum()
    return as_kernel(current)


def second_moments(kernel: npt.NDArray[np.float64], level: float = WING_LEVEL) -> npt.NDArray[np.float64]:
    """Central second moments in px², [[rr, rc], [rc, cc]], of the values above `level` times the peak."""
    core = np.where(kernel > level * kernel.max(), kernel, 0.0)
    core = core / core.sum()
    row, col = centroid(core)
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    dr, dc = (t - row)[:, None], (t - col)[None, :]
    rc = float((core * dr * dc).sum())
    return np.array([[float((core * dr * dr).sum()), rc], [rc, float((core * dc * dc).sum())]])


def rms_width(kernel: npt.NDArray[np.float64]) -> float:
    """Root of the mean second moment per axis, in pixels (the sigma of a round Gaussian)."""
    return math.sqrt(max(float(np.trace(second_moments(kernel))) / 2.0, 0.0))


def otf(kernel: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.complex128]:
    """Transfer function on an `rfft2` grid of `shape`, the middle pixel at the origin."""
    size = kernel.shape[0]
    if size > min(shape):
        raise InvalidInputError(f"a kernel of side {size} does not fit a grid of {shape}")
    grid = np.zeros(shape)
    grid[:size, :size] = kernel
    return scipy.fft.rfft2(np.roll(grid, (-(size // 2), -(size // 2)), axis=(0, 1)))


def whole_peak(cross: npt.NDArray[np.complex128]) -> tuple[int, int]:
    """Whole pixels `(row, col)` by which A lies beyond B, from their cross spectrum A conj(B)."""
    n, surface = len(cross), scipy.fft.ifft2(cross).real
    row, col = (np.array(np.unravel_index(surface.argmax(), surface.shape)) + n // 2) % n - n // 2
    return int(row), int(col)


def correlation_peak(
    cross: npt.NDArray[np.complex128], near: tuple[int, int]
) -> tuple[tuple[float, float], float]:
    """Shift `(row, col)` near whole pixels at which a correlation peaks, and its value there.

    By Newton steps on the Fourier series c(d) = 1/n² sum_f cross(f) exp(2 pi i f d).
    """
    n, d = len(cross), np.array(near, dtype=np.float64)
    freq = 2.0 * np.pi * scipy.fft.fftfreq(n)

    def phased() -> npt.NDArray[np.complex128]:
        return cross * np.outer(np.exp(1j * freq * d[0]), np.exp(1j * freq * d[1]))

    for _ in range(8):
        waves = phased()
        gradient = -np.array([freq @ waves.sum(axis=1).imag, freq @ waves.sum(axis=0).imag])
        mixed = freq @ waves.real @ freq
        own = [freq**2 @ waves.sum(axis=axis).real for axis in (1, 0)]
        hessian = -np.array([[own[0], mixed], [mixed, own[1]]])
        if np.linalg.eigvalsh(hessian)[-1] >= 0.0:
            break
        step = np.clip(-np.linalg.solve(hessian, gradient), -0.5, 0.5)
        d += step
        if np.abs(step).max() < 1e-6:
            break
    return (float(d[0]), float(d[1])), float(phased().real.sum()) / n**2


TOKEN_LENGTH: Final = 192  # numbers of the token of a patch
KINDS: Final[tuple[PatchKind, ...]] = get_args(PatchKind)


@dataclass(frozen=True, slots=True, eq=False)
class EncodedPatch:
    """What a patch of a photo says of the lens without a kernel: the input of attention over many patches."""

    # (n,), statistics of its pixels (`lensmodel.neural.network`), turned into the octant of its place
    statistics: npt.NDArray[np.float16]
    # (192,), what the network made of them beside the other patches of the photo
    token: npt.NDArray[np.float16]
    kind: PatchKind = "raw"  # kind of file, which tells how its pixels were made

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InvalidInputError(f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}")
        for name, values in (("statistics", self.statistics), ("token", self.token)):
            own = np.array(values, dtype=np.float16)
            if own.ndim != 1 or not np.isfinite(own).all():
                raise InvalidInputError(f"the {name} of a patch must be a row of finite numbers")
            own.setflags(write=False)
            object.__setattr__(self, name, own)
        if self.token.size != TOKEN_LENGTH:
            raise InvalidInputError(f"a token has {TOKEN_LENGTH} numbers, got {self.token.size}")

    def to_bytes(self) -> bytes:
        """Serialise: number of the kind, then token and statistics as little-endian float16."""
        numbers = np.concatenate([self.token, self.statistics]).astype("<f2")
        return bytes([KINDS.index(self.kind)]) + numbers.tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> EncodedPatch:
        """Read what `to_bytes` wrote."""
        if len(data) % 2 == 0 or len(data) <= 2 * TOKEN_LENGTH or data[0] >= len(KINDS):
            raise InvalidInputError(f"an encoded patch was not written by this program ({len(data)} bytes)")
        numbers = np.frombuffer(data, dtype="<f2", offset=1)
        return cls(numbers[TOKEN_LENGTH:], numbers[:TOKEN_LENGTH], KINDS[data[0]])


MEASURED: Final = "measured-"
"""How the names of estimators begin that measure: blind ones never do."""


@dataclass(frozen=True, slots=True, eq=False)
class PsfSample:
    """One local PSF estimate: what was seen, where, at which settings, how sure.

    Values that are out of their range raise `InvalidInputError`. Source: M. Hirsch, B. Schölkopf,
    "Self-Calibration of Optical Lenses", ICCV 2015, sections 5 and 6.

    Parameters
    ----------
    kernel : Kernel, float64, shape (k, k)
        k odd; finite, not negative and not all zero, on the sensor's pixel grid in sensor orientation. It is
        copied, normalized and read-only here.
    position : FieldPosition
        Centre of the patch that it was seen in.
    settings : LensSettings
        Aperture, focal length, focus distance and channel of the photo.
    weight : float
        Confidence in 0..1; scales its part in answers.
    photo : str
        Which photo it came from: samples of one photo share its faults.
    pixel_pitch_um : float or None
        Size of a sensor pixel in micrometres; None where unknown.
    estimator : str
        Name and version of the method that made it.
    encoded : EncodedPatch or None
        What the patch says without a kernel, the same for its three channels; None of samples that were
        measured, or made by an estimator that knows kernels alone.
    error : float or None
        Relative L2 distance to the truth that the method expects of it; None where it says nothing.
    half_diagonal_px : float or None
        Half the diagonal of the frame in pixels; None where unknown.
    """

    kernel: Kernel
    position: FieldPosition
    settings: LensSettings = field(default_factory=LensSettings)
    weight: float = 1.0
    photo: str = ""
    pixel_pitch_um: float | None = None
    estimator: str = ""
    encoded: EncodedPatch | None = None
    error: float | None = None
    half_diagonal_px: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", as_kernel(self.kernel))
        if not 0.0 <= self.weight <= 1.0:
            raise InvalidInputError(f"weight must lie in 0..1, got {self.weight}")
        for name, unit, size in (
            ("pixel pitch", "micrometres", self.pixel_pitch_um),
            ("half diagonal", "pixels", self.half_diagonal_px),
        ):
            if size is not None and not (math.isfinite(size) and size > 0):
                raise InvalidInputError(f"the {name} must be positive {unit}, got {size}")
        if self.error is not None and not (math.isfinite(self.error) and self.error >= 0.0):
            raise InvalidInputError(f"the expected error must be finite and not negative, got {self.error}")

    @property
    def measured(self) -> bool:
        """Whether it was measured on a photo made for it, and not estimated from an ordinary one."""
        return self.estimator.startswith(MEASURED)


def places_of(samples: Iterable[PsfSample]) -> int:
    """Count the places that samples show, in the colour that has most of them."""
    return max(Counter(sample.settings.channel for sample in samples).values(), default=0)


class PsfField(Protocol):
    """A PSF for every place and channel: what a correction needs to know of a lens."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size` at a field position, in the image frame."""
