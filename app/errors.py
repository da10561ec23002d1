"""Errors of the service; `app.http.errors` turns them into responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from lensmodel.core.errors import LensModelError

OTHER_LENS_REMEDY: Final = "choose its own lens, or send any_lens=true if it is the same"


class ServiceError(LensModelError):
    """Something that the service itself refuses: why and the remedy, its fixed code, headers of the answer.

    `status` is that of the response where it is not the usual one of the code.
    """

    def __init__(
        self,
        detail: str,
        *,
        code: str | None = None,
        status: int | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.code = code or type(self).code  # type: ignore[misc]  # of this one, where the class has several
        self.status, self.headers = status, dict(headers or {})


class InvalidParameterError(ServiceError):
    """A value outside its range."""

    code = "invalid_parameter"


class UnknownError(ServiceError):
    """No photo, lens, correction or job of that id, or somebody else's."""

    def __init__(self, what: str, key: str) -> None:
        super().__init__(f"there is no {what} {key[:60]}: it may have been deleted", code=f"unknown_{what}")


class NotReadyError(ServiceError):
    """The result is not finished yet."""

    code = "not_ready"


class ConflictError(ServiceError):
    """The state does not allow it."""

    code = "conflict"


class BusyError(ServiceError):
    """Too much is in progress already."""

    code = "busy"


class QuotaError(ServiceError):
    """The owner has too much unfinished or stored already."""

    code = "quota_exceeded"
