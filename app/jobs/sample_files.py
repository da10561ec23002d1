"""PSF samples between workers and their tasks: what the codec of samples makes of them, as files of a folder.

In the folder `KERNELS` and `ENCODED` are npy files, `SAMPLES` is JSON; see `PackedSamples`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Final

import numpy as np
from numpy.lib.format import open_memmap

from app.jobs.answers import ENCODED, KERNELS, SAMPLES
from app.sandbox.child import MAX_RESULT
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import save_array
from lensmodel.core.psf import PsfSample
from lensmodel.model.profile import PackedSamples, pack_samples, unpack_samples

# Pixels across a returned kernel at most (chosen): as in a profile, docs/topics/profile-format.md
MAX_SIDE: Final = 255
# What reading the answer of a task raises if the task did not write what it should
DAMAGED: Final = (
    InvalidInputError,
    OSError,
    *(ValueError, TypeError, LookupError, AttributeError),  # other shapes, or not the expected JSON
    *(ArithmeticError, MemoryError, RecursionError),  # numbers, arrays and lists as large as one may claim
    TokenError,  # a header that NumPy takes for one of Python 2
)


def write_samples(folder: Path, samples: Sequence[PsfSample]) -> None:
    """Write samples for a task, or for the worker that waits for them."""
    packed = pack_samples(samples)
    with (folder / KERNELS).open("wb") as file:
        save_array(file, packed.kernels)
    if packed.encoded.size:
        with (folder / ENCODED).open("wb") as file:
            save_array(file, packed.encoded)
    (folder / SAMPLES).write_text(json.dumps(packed.entries), encoding="utf-8")


def read_samples(folder: Path) -> list[PsfSample]:
    """Read what `write_samples` wrote."""
    return unpack_samples(_packed(folder))


def returned_samples(folder: Path, *, count: int) -> list[PsfSample]:
    """Read the samples that a task returned, as untrusted input."""
    if (folder / SAMPLES).stat().st_size > MAX_RESULT:
        raise InvalidInputError(f"{SAMPLES} is larger than {MAX_RESULT} bytes")
    packed = _packed(folder)
    entries, kernels = packed.entries, packed.kernels
    if not isinstance(entries, list) or kernels.ndim != 3 or kernels.dtype != "<f4":
        raise InvalidInputError(f"samples that the codec did not write: kernels {kernels.shape}")
    if not len(entries) == len(kernels) == count or kernels.shape[1] > MAX_SIDE:
        raise InvalidInputError(
            f"{count} samples announced, {len(entries)} and kernels {kernels.shape} written"
        )
    return unpack_samples(packed)


def _packed(folder: Path) -> PackedSamples:
    entries = json.loads((folder / SAMPLES).read_text(encoding="utf-8"))
    path = folder / ENCODED
    # mapped, since a header may claim any size; never an archive or a pickle in its place
    encoded = open_memmap(path, mode="r") if path.is_file() else np.empty((0, 0), dtype=np.uint8)
    return PackedSamples(entries, open_memmap(folder / KERNELS, mode="r"), encoded)
