"""Errors of the service; `app.http.errors` turns them into responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from lensmodel.core.errors import LensModelError

if TYPE_CHECKING:
    from app.schemas import FieldError


class ServiceError(LensModelError):
    """Something that the service itself refuses.

    Parameters
    ----------
    detail : str
        The offending value and the remedy.
    errors : sequence of FieldError
        One entry for each offending field.
    headers : mapping of str to str
        For the answer.
    """

    def __init__(
        self, detail: str, *, errors: Sequence[FieldError] = (), headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(detail)
        self.errors = tuple(errors)
        self.headers = dict(headers or {})


class MalformedUploadError(ServiceError):
    """The body has not the form of an upload."""

    code = "malformed_upload"


class InvalidParameterError(ServiceError):
    """A value outside its range."""

    code = "invalid_parameter"


class UnknownPhotoError(ServiceError):
    """No photo of that id, or somebody else's."""

    code = "unknown_photo"


class UnknownPictureError(ServiceError):
    """No such part of a picture."""

    code = "unknown_photo"


class UnknownLensError(ServiceError):
    """No lens of that id, or somebody else's."""

    code = "unknown_lens"


class UnknownCorrectionError(ServiceError):
    """No correction of that id, or somebody else's."""

    code = "unknown_correction"


class UnknownJobError(ServiceError):
    """No job of that id, or somebody else's."""

    code = "unknown_job"


class NotSignedInError(ServiceError):
    """No valid key or session."""

    code = "not_signed_in"


class ForbiddenError(ServiceError):
    """The key does not allow this."""

    code = "forbidden"


class NotReadyError(ServiceError):
    """The result is not finished yet."""

    code = "not_ready"


class ConflictError(ServiceError):
    """The state does not allow it."""

    code = "conflict"


class OtherLensError(ConflictError):
    """It seems to be of another lens than the one that is named for it."""

    code = "other_lens"


class NotAcceptableError(ServiceError):
    """None of the accepted formats is available."""

    code = "not_acceptable"


class TooLargeError(ServiceError):
    """More bytes than an upload may have."""

    code = "image_too_large"


class SlowBodyError(ServiceError):
    """A body that arrives too slowly or not at all."""

    code = "too_slow"


class BusyError(ServiceError):
    """Too much is in progress already."""

    code = "busy"


class QuotaError(ServiceError):
    """The owner has too much unfinished or stored already."""

    code = "quota_exceeded"


class StorageFullError(ServiceError):
    """No room for another photo."""

    code = "quota_exceeded"


class RangeError(ServiceError):
    """A byte range beyond the end of the file."""

    code = "invalid_parameter"
