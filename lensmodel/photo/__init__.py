"""Photo files in and out: RAW, DNG, TIFF, PNG, JPEG; EXIF, ICC; which lens it was."""

from lensmodel.photo.containers import HEAD_BYTES, sniff
from lensmodel.photo.development import develop, inspect
from lensmodel.photo.values import (
    ColorSpace,
    Encoding,
    LensIdentity,
    Limits,
    LinearPhoto,
    OutputFormat,
    PhotoInfo,
    PhotoMetadata,
)
from lensmodel.photo.writing import shown, upright, write_image

__all__ = [
    "HEAD_BYTES",
    "ColorSpace",
    "Encoding",
    "LensIdentity",
    "Limits",
    "LinearPhoto",
    "OutputFormat",
    "PhotoInfo",
    "PhotoMetadata",
    "develop",
    "inspect",
    "shown",
    "sniff",
    "upright",
    "write_image",
]
