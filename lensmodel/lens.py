"""A lens as one value: what it was calibrated from, what it answers, and the profile that keeps it.

A profile is a zip of JSON and npy that opens anywhere and gives the same PSFs. Layout, format 2::

    profile.json    format, lens, cameras, settings of the model, one entry for each sample
    kernels.npy     (n, k, k) float32, sum 1, centred, in the order of the entries
    encoded.npy     (m, bytes) uint8: what patches say without a kernel, see `EncodedPatch`

Nothing in it can run code: no pickle, sizes bounded before arrays are made. Samples cross the service, to
its tasks and tables, in the same form.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Final, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.names import full_name
from lensmodel.core.psf import EncodedPatch, PsfSample, centred
from lensmodel.core.types import Channel, FieldPosition, LensSettings, field_grid
from lensmodel.model import LensModel, PsfAnswer
from lensmodel.model.identity import Camera, Identity
from lensmodel.quality import mtf50_from_kernel, mtf_from_kernel

_FORMAT: Final = 2  # raised when samples of before mean nothing to the model any more
_MAX_BYTES: Final = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES: Final = 200_000  # some 700 photos of 96 patches in three colours (chosen: memory)
_MAX_SIDE: Final = (
    255  # pixels: several times the widest kernels; larger files would fill the memory (chosen)
)
_KERNELS, _ENCODED = "kernels.npy", "encoded.npy"
_INFINITY: Final = "infinity"  # a focus distance for which JSON has no number

DEFAULT_SIZE: Final = 55  # pixels (chosen): side of a kernel that a correction uses, so that the same is seen


class Settings(TypedDict, total=False):
    """Settings of the lens that a question may name."""

    aperture: float | None
    focal_mm: float | None
    focus_m: float | None
    channel: Channel


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Lens:
    """One copy of a lens: its PSF at every place of the picture, aperture and color.

    The PSF is the function f(u, v, r, phi, settings) of M. Hirsch and B. Schölkopf, "Self-Calibration of
    Optical Lenses", ICCV 2015, section 6. Places are field positions: `r` is the distance to the centre over
    the half diagonal (0 centre, 1 corner), `phi` the angle in radians, counter-clockwise from the right, in
    sensor orientation. Kernels are float64, of odd side, not negative, of sum 1, on the pixel grid of the
    sensor that the lens was calibrated on.

    Lenses are values: nothing changes one. Make them with `calibrate`, `Lens.from_kernels` or `Lens.load`.
    """

    model: LensModel  # the function behind the answers
    names: Mapping[str, str] = field(default_factory=dict)  # what is known of maker, model, serial and label
    photos: Mapping[str, str] = field(default_factory=dict)  # file names by the id that samples carry
    cameras: tuple[Camera, ...] = ()  # what the photos were taken with, each once; empty where none says

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
        return read_profile(path, Path(path).name)

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


# --- the profile ---------------------------------------------------------------------------------


def write_profile(file: IO[bytes], lens: Lens) -> None:
    """Write a lens to an open file."""
    count, side = len(lens.samples), max(sample.kernel.shape[0] for sample in lens.samples)
    if not _within_limits(count, side):
        raise InvalidInputError(
            f"a profile holds {_MAX_SAMPLES} samples of side {_MAX_SIDE}, not {count} of side {side}"
        )
    packed = pack_samples(lens.samples)
    document = {
        "format": _FORMAT,
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "lens": dict(lens.names),
        "photos": dict(lens.photos),
        "cameras": [{k: text for k, text in asdict(of).items() if text} for of in lens.cameras],
        "model": {"mode": lens.model.mode},
        "samples": packed.entries,
    }
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", json.dumps(document, allow_nan=False))
        for name, array in ((_KERNELS, packed.kernels), (_ENCODED, packed.encoded)):
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            archive.writestr(name, buffer.getvalue())
        if _unpacked(archive) > _MAX_BYTES:
            raise InvalidInputError(f"a profile holds {_MAX_BYTES >> 20} MiB at most; save fewer samples")


def _within_limits(count: int, side: int) -> bool:
    return 0 < count <= _MAX_SAMPLES and side <= _MAX_SIDE


def _unpacked(archive: zipfile.ZipFile) -> int:
    return sum(entry.file_size for entry in archive.infolist())


def read_profile(source: Path | str | IO[bytes], name: str) -> Lens:
    """Open a profile by its path or as an open file; errors call it `name`."""
    try:
        with zipfile.ZipFile(source) as archive:
            return _read(archive, name)
    except (FileNotFoundError, LensModelError):
        raise
    except Exception as error:  # zipfile, json and NumPy fail in a dozen ways on files made to do harm
        raise InvalidInputError(f"{name} is no lens profile, or a damaged one; give another file") from error


def _read(archive: zipfile.ZipFile, name: str) -> Lens:
    if _unpacked(archive) > _MAX_BYTES:
        raise InvalidInputError(f"{name} unpacks to more than {_MAX_BYTES >> 20} MiB; it is no lens profile")
    document = json.loads(archive.read("profile.json"))
    if document["format"] != _FORMAT:
        raise InvalidInputError(
            f"{name} has profile format {document['format']}, this program reads {_FORMAT}: its "
            "samples are not those of this program; calibrate again with the photos of the lens"
        )
    stack, encoded = (
        np.asarray(np.load(io.BytesIO(archive.read(part)), allow_pickle=False))
        for part in (_KERNELS, _ENCODED)
    )
    entries = document["samples"]
    fits = stack.ndim == 3 and len(entries) == len(stack) and _within_limits(*stack.shape[:2])
    if not fits or stack.dtype != np.float32:
        raise InvalidInputError(
            f"{name} holds {len(entries)} samples but kernels of shape {stack.shape}; "
            f"one is needed for each, of side {_MAX_SIDE} at most"
        )
    samples = unpack_samples(PackedSamples(entries, stack, encoded))
    model = LensModel.fit(samples, document["model"].get("mode", "default"))
    cameras = tuple(Camera(**_texts(camera)) for camera in document.get("cameras", []))
    return Lens(model, _texts(document["lens"]), _texts(document["photos"]), cameras)


def _texts(values: dict[str, Any]) -> dict[str, str]:
    return {str(key)[:200]: str(value)[:200] for key, value in values.items()}


@dataclass(frozen=True, slots=True, eq=False)
class PackedSamples:
    """Samples as JSON and arrays."""

    # `entry_of` each sample, and in `encoded` the row of its patch, which its channels share, or None
    entries: list[dict[str, Any]]
    kernels: NDArray[np.float32]  # (n, k, k), zeros around kernels that are smaller than the largest
    encoded: NDArray[np.uint8]  # (m, bytes), `EncodedPatch.to_bytes` of the patches


def pack_samples(samples: Sequence[PsfSample]) -> PackedSamples:
    """Turn samples into what `unpack_samples` reads."""
    side = max(sample.kernel.shape[0] for sample in samples)
    kernels = np.zeros((len(samples), side, side), dtype=np.float32)
    patches: dict[bytes, int] = {}
    entries = []
    for number, sample in enumerate(samples):
        kernels[number][_middle(side, sample.kernel.shape[0])] = sample.kernel
        row = None if sample.encoded is None else patches.setdefault(sample.encoded.to_bytes(), len(patches))
        entries.append({**entry_of(sample), "encoded": row})
    rows = [np.frombuffer(data, dtype=np.uint8) for data in patches]
    return PackedSamples(entries, kernels, np.stack(rows) if rows else np.empty((0, 0), dtype=np.uint8))


def unpack_samples(packed: PackedSamples) -> list[PsfSample]:
    """Build the samples that `pack_samples` was given."""
    if packed.encoded.ndim != 2 or packed.encoded.dtype != np.uint8:
        raise ValueError(f"encoded patches of shape {packed.encoded.shape}")
    patches = [EncodedPatch.from_bytes(row.tobytes()) for row in packed.encoded]
    side = packed.kernels.shape[1]
    samples = []
    for entry, kernel in zip(packed.entries, packed.kernels, strict=True):
        row = entry["encoded"]
        if not (row is None or (isinstance(row, int) and 0 <= row < len(patches))):
            raise ValueError(f"no encoded patch {row!r}, there are {len(patches)}")
        own = kernel[_middle(side, int(entry["size"]))]
        samples.append(sample_of(entry, own, None if row is None else patches[row]))
    return samples


def _middle(side: int, size: int) -> tuple[slice, slice]:
    """The middle `size` rows and columns of `side`."""
    margin, odd = divmod(side - size, 2)
    if not 0 < size <= side or odd:
        raise ValueError(f"kernels of side {size} in an array of side {side}")
    return slice(margin, margin + size), slice(margin, margin + size)


# Fields of a sample that its entry holds as they are
_NAMED_ALIKE: Final = ("weight", "photo", "pixel_pitch_um", "half_diagonal_px", "estimator", "error")


def entry_of(sample: PsfSample) -> dict[str, Any]:
    """Return the named fields of a sample: all of it but the kernel and the encoded patch."""
    settings = asdict(sample.settings)
    if settings["focus_m"] == math.inf:
        settings["focus_m"] = _INFINITY
    named = {name: getattr(sample, name) for name in _NAMED_ALIKE}
    return {"size": sample.kernel.shape[0], **asdict(sample.position), "settings": settings, **named}


def sample_of(
    entry: Mapping[str, Any], kernel: NDArray[np.float32], encoded: EncodedPatch | None
) -> PsfSample:
    """Build the sample of which `entry_of` returned the fields."""
    settings = dict(entry["settings"])
    if settings.get("focus_m") == _INFINITY:
        settings["focus_m"] = math.inf
    place = FieldPosition(float(entry["r"]), float(entry["phi"]))
    named = {name: entry[name] for name in _NAMED_ALIKE}
    named |= {name: str(named[name]) for name in ("photo", "estimator")}
    values = np.asarray(kernel, dtype=np.float64)
    return PsfSample(values, place, LensSettings(**settings), encoded=encoded, **named)
