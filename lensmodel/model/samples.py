"""PSF samples as named fields and arrays, and back: in profiles, in tasks of the service, in its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings

_INFINITY: Final = "infinity"  # a focus distance for which JSON has no number


@dataclass(frozen=True, slots=True, eq=False)
class PackedSamples:
    """Samples as JSON and arrays."""

    # named fields of each sample, of what `json` can write; `size` is the side of its kernel, `encoded` the
    # row of its patch in `encoded`, which the channels of one patch share, or None
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
        own = kernel[_middle(side, int(entry["size"]))]
        samples.append(sample_of(entry, own, None if row is None else patches[_row(row, len(patches))]))
    return samples


def _row(number: Any, count: int) -> int:  # noqa: ANN401 - of a JSON document
    if not isinstance(number, int) or not 0 <= number < count:
        raise ValueError(f"no encoded patch {number!r}, there are {count}")
    return number


def _middle(side: int, size: int) -> tuple[slice, slice]:
    """The middle `size` rows and columns of `side`."""
    margin, odd = divmod(side - size, 2)
    if not 0 < size <= side or odd:
        raise ValueError(f"kernels of side {size} in an array of side {side}")
    return slice(margin, margin + size), slice(margin, margin + size)


def entry_of(sample: PsfSample) -> dict[str, Any]:
    """Return the named fields of a sample: all of it but the kernel and the encoded patch."""
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
    }


def sample_of(
    entry: Mapping[str, Any], kernel: NDArray[np.float32], encoded: EncodedPatch | None
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
        encoded=encoded,
        error=entry["error"],
        half_diagonal_px=entry["half_diagonal_px"],
    )
