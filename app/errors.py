"""What the service refuses, and with which status; `app.http.errors` turns it into answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

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

    status: ClassVar[int] = 400

    def __init__(
        self, detail: str, *, errors: Sequence[FieldError] = (), headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(detail)
        self.errors = tuple(errors)
        self.headers = dict(headers or {})


class MalformedUploadError(ServiceError):
    """The body is not what an upload looks like."""

    code = "malformed_upload"


class InvalidParameterError(ServiceError):
    """A value outside its range."""

    status, code = 422, "invalid_parameter"


class UnknownPhotoError(ServiceError):
    """No photo of that id, or somebody else's."""

    status, code = 404, "unknown_photo"


class UnknownPictureError(ServiceError):
    """No part of a picture there."""

    status, code = 404, "unknown_photo"


class UnknownLensError(ServiceError):
    """No lens of that id, or somebody else's."""

    status, code = 404, "unknown_lens"


class UnknownCorrectionError(ServiceError):
    """No correction of that id, or somebody else's."""

    status, code = 404, "unknown_correction"


class UnknownJobError(ServiceError):
    """No job of that id, or somebody else's."""

    status, code = 404, "unknown_job"


class NotSignedInError(ServiceError):
    """Nobody knows who asks."""

    status, code = 401, "not_signed_in"


class ForbiddenError(ServiceError):
    """Who asks is known, and may not do this."""

    status, code = 403, "forbidden"


class NotReadyError(ServiceError):
    """What was asked for is still being made."""

    status, code = 409, "not_ready"


class ConflictError(ServiceError):
    """The state does not allow it."""

    status, code = 409, "conflict"


class NotAcceptableError(ServiceError):
    """None of the formats that the caller accepts exists."""

    status, code = 406, "not_acceptable"


class TooLargeError(ServiceError):
    """More bytes than an upload may have."""

    status, code = 413, "image_too_large"


class SlowBodyError(ServiceError):
    """A body that does not come, or hardly."""

    status, code = 408, "too_slow"


class BusyError(ServiceError):
    """Too much is being done already."""

    status, code = 503, "busy"


class QuotaError(ServiceError):
    """The owner has too much unfinished or stored already."""

    status, code = 429, "quota_exceeded"


class StorageFullError(ServiceError):
    """No room for another photo."""

    status, code = 507, "quota_exceeded"


class RangeError(ServiceError):
    """A byte range beyond the end of the file."""

    status, code = 416, "invalid_parameter"
