"""What other photos of a body tell of the defective pixels of its sensor."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Final

from lensmodel.core.errors import LensModelError
from lensmodel.core.names import name_key, serial_key
from lensmodel.photo.defects import Suspects
from lensmodel.photo.headers.opening import opened_header
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.raw import opened_raw
from lensmodel.photo.tags.metadata import metadata_of
from lensmodel.photo.values import Limits, PhotoMetadata

_MOST: Final = 7
"""Photos that are asked (chosen): with eight a pixel that stands out in one of three pictures is found."""

_KEPT: Final = 256  # answers (chosen): each is some thousand numbers
_RAW: Final = {"raw", "dng"}


def suspects_of_siblings(
    path: Path, metadata: PhotoMetadata, siblings: Iterable[Path], limits: Limits
) -> list[Suspects]:
    """Ask other RAW photos of the same body; what cannot be read, or is of another body, is passed over."""
    told: list[Suspects] = []
    for sibling in siblings:
        if len(told) == _MOST:
            break
        try:
            status = sibling.stat()
            if os.path.samestat(status, path.stat()):
                continue
            one = _suspects(sibling, status.st_mtime_ns, status.st_size, limits)
        except (LensModelError, OSError):
            continue
        if one is not None and one[0] == _body(metadata):
            told.append(one[1])
    return told


@lru_cache(maxsize=_KEPT)
def _suspects(
    path: Path, changed_ns: int, size: int, limits: Limits
) -> tuple[tuple[str, ...], Suspects] | None:
    """The body of a photo and what its mosaic shows; None without a mosaic or a known body."""
    del changed_ns, size  # a file that changed is another one
    with opened_header(path, limits) as header:
        body = _body(metadata_of(header))
        if header.kind not in _RAW or not body[0]:
            return None
        with opened_raw(path) as raw:
            mosaic = Mosaic.of(raw)
            return None if mosaic is None else (body, mosaic.suspects())


def _body(metadata: PhotoMetadata) -> tuple[str, ...]:
    return name_key(metadata.camera_model), serial_key(metadata.body_serial)
