"""What can go wrong: every text names the offending value and the remedy, `code` is the word for programs.

The caller can mend an `InvalidInputError` (HTTP 422); the photo is to blame for an `UnreadablePhotoError`
(415), an `ImageTooLargeError` (413), a `MetadataMissingError` (422); more photos may help a
`NotEnoughEvidenceError` (409).
"""

from __future__ import annotations

from typing import ClassVar


class LensModelError(Exception):
    """Base of every exception that this library raises on purpose."""

    code: ClassVar[str] = "error"


class InvalidInputError(LensModelError):
    """A value outside its range, or of the wrong shape; the text says which and what is allowed."""

    code: ClassVar[str] = "invalid_parameter"


class UnreadablePhotoError(LensModelError):
    """A file that cannot be decoded as a photo."""

    code: ClassVar[str] = "not_an_image"


class NotAnImageError(UnreadablePhotoError):
    """The first bytes belong to no image format."""


class TruncatedImageError(UnreadablePhotoError):
    """The file ends before its picture does."""

    code: ClassVar[str] = "truncated_image"


class UnsupportedFormatError(UnreadablePhotoError):
    """An image, but of a kind that we do not read."""

    code: ClassVar[str] = "unsupported_format"


class RawDecodeError(UnreadablePhotoError):
    """LibRaw opened the file but what came out is no photograph."""

    code: ClassVar[str] = "raw_decode_failed"


class ImageTooLargeError(LensModelError):
    """More pixels or bytes than the limits allow."""

    code: ClassVar[str] = "image_too_large"


class DecompressionBombError(ImageTooLargeError):
    """A small file that claims a huge picture."""

    code: ClassVar[str] = "decompression_bomb"


class MetadataMissingError(LensModelError):
    """The photo does not say which lens or setting it was taken with."""

    code: ClassVar[str] = "metadata_missing"


class NotEnoughEvidenceError(LensModelError):
    """The photo or the model cannot answer yet."""

    code: ClassVar[str] = "no_samples"


class NoUsablePatchesError(NotEnoughEvidenceError):
    """No part of the photo tells about the blur."""

    code: ClassVar[str] = "no_usable_patches"


class TurnedPixelsError(NotEnoughEvidenceError):
    """Nobody can tell how the photo lay on the sensor."""

    code: ClassVar[str] = "turned_pixels"


class NoSamplesError(NotEnoughEvidenceError):
    """The lens has no PSF samples yet."""


class OutsideSupportError(NotEnoughEvidenceError):
    """The question lies outside what the samples cover."""

    code: ClassVar[str] = "outside_support"


class CancelledError(LensModelError):
    """The work was cancelled by its owner."""

    code: ClassVar[str] = "cancelled"
