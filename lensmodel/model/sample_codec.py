"""PSF samples as named fields and arrays, and back: in profiles, in tasks of the service, in its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.spectrum import PHASE_BINS, RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import FieldPosition, LensSettings

_INFINITY: Final = "infinity"
"""A focus distance for which JSON has no number."""
_SPECTRUM: Final = RINGS * SECTORS + 3
"""Numbers of a spectrum: power, noise and two of the tail."""
_PHASES: Final = 2 * PHASE_BINS
"""Numbers of what a spectrum says of phases: each with its precision."""


@dataclass(frozen=True, slots=True, eq=False)
class PackedSamples:
    """Samples as JSON and arrays.

    Parameters
    ----------
    entries : list of dict
        Named fields of each sample, of what `json` can write; `size` is the side of its kernel.
    kernels : ndarray of float32, shape (n, k, k)
        Zeros around kernels that are smaller than the largest.
    spectra : ndarray of float32, shape (n, 171), or None
        `PatchSpectrum.to_bytes` without phases, NaN where a sample has none; None where none has.
    phases : ndarray of float32, shape (n, 168), or None
        The phases alike; kept apart, since earlier programs read spectra without.
    """

    entries: list[dict[str, Any]]
    kernels: NDArray[np.float32]
    spectra: NDArray[np.float32] | None
    phases: NDArray[np.float32] | None = None


def pack_samples(samples: Sequence[PsfSample]) -> PackedSamples:
    """Turn samples into what `unpack_samples` reads.

    Parameters
    ----------
    samples : sequence of PsfSample
        One at least.

    Returns
    -------
    PackedSamples
        Kernels are rounded to single precision.
    """
    side = max(sample.kernel.shape[0] for sample in samples)
    kernels = np.zeros((len(samples), side, side), dtype=np.float32)
    numbers = np.full((len(samples), _SPECTRUM + _PHASES), np.nan, dtype="<f4")
    for number, sample in enumerate(samples):
        kernels[number][_middle(side, sample.kernel.shape[0])] = sample.kernel
        if sample.spectrum is not None:
            own = np.frombuffer(sample.spectrum.to_bytes(), dtype="<f4")
            numbers[number, : own.size] = own
    parts = (
        None if np.isnan(rows).all() else np.ascontiguousarray(rows)
        for rows in np.split(numbers, [_SPECTRUM], axis=1)
    )
    return PackedSamples([entry_of(sample) for sample in samples], kernels, *parts)


def unpack_samples(packed: PackedSamples) -> list[PsfSample]:
    """Build the samples that `pack_samples` was given.

    Parameters
    ----------
    packed : PackedSamples
        Entries without `size`, of profiles of earlier versions, have kernels as large as the array.

    Returns
    -------
    list of PsfSample

    Raises
    ------
    InvalidInputError
        If a value is out of its range.
    KeyError, TypeError, ValueError
        If entries and arrays are not those of `pack_samples`.
    """
    count, side = len(packed.entries), packed.kernels.shape[1]
    spectra, phases = _rows(packed.spectra, count, _SPECTRUM), _rows(packed.phases, count, _PHASES)
    samples = []
    for number, (entry, kernel) in enumerate(zip(packed.entries, packed.kernels, strict=True)):
        row = spectra[number] + phases[number] if spectra[number] else None
        size = int(entry["size"]) if "size" in entry else side
        own = kernel[_middle(side, size)]
        samples.append(sample_of(entry, own, None if row is None else PatchSpectrum.from_bytes(row)))
    return samples


def _rows(array: NDArray[np.float32] | None, count: int, numbers: int) -> list[bytes]:
    """Bytes of each sample; none where there are no numbers."""
    if array is None:
        return [b""] * count
    if array.shape != (count, numbers) or array.dtype != np.float32:
        raise ValueError(f"spectra of shape {array.shape} for {count} samples")
    return [b"" if np.isnan(row).all() else row.tobytes() for row in array]


def _middle(side: int, size: int) -> tuple[slice, slice]:
    """The middle `size` rows and columns of `side`."""
    margin, odd = divmod(side - size, 2)
    if not 0 < size <= side or odd:
        raise ValueError(f"kernels of side {size} in an array of side {side}")
    return slice(margin, margin + size), slice(margin, margin + size)


def entry_of(sample: PsfSample) -> dict[str, Any]:
    """Return the named fields of a sample: all of it but the kernel and the spectrum."""
    settings = asdict(sample.settings)
    if settings["focus_m"] is not None and math.isinf(settings["focus_m"]):
        settings["focus_m"] = _INFINITY
    return {
        "size": sample.kernel.shape[0],
        "r": sample.position.r,
        "phi": sample.position.phi,
        "settings": settings,
        "weight": sample.weight,
        "photo": sample.photo,
        "pixel_pitch_um": sample.pixel_pitch_um,
        "half_diagonal_px": sample.half_diagonal_px,
        "estimator": sample.estimator,
        "error": sample.error,
        "darkest": sample.darkest,
    }


def sample_of(
    entry: Mapping[str, Any], kernel: NDArray[np.float32], spectrum: PatchSpectrum | None
) -> PsfSample:
    """Build the sample of which `entry_of` returned the fields."""
    settings = dict(entry["settings"])
    if settings.get("focus_m") == _INFINITY:
        settings["focus_m"] = math.inf
    return PsfSample(
        kernel=np.asarray(kernel, dtype=np.float64),
        position=FieldPosition(float(entry["r"]), float(entry["phi"])),
        settings=LensSettings(**settings),
        weight=float(entry["weight"]),
        photo=str(entry["photo"]),
        pixel_pitch_um=entry["pixel_pitch_um"],
        estimator=str(entry["estimator"]),
        spectrum=spectrum,
        error=entry.get("error"),
        half_diagonal_px=entry.get("half_diagonal_px"),
        darkest=entry.get("darkest"),
    )
