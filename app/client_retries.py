"""Requests sent again where the service cannot be reached for a moment, or asks to come back later."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import httpx2

RETRIES: Final = 3
FIRST_PAUSE_S: Final = 0.5
"""Number of retries, and the first pause, doubled each time (chosen): three pauses of together 3.5 s bridge
the restart of an API process."""

LONGEST_PAUSE_S: Final = 30.0
"""Where the service asks for a longer pause, its refusal is handed on (chosen): it may take long."""

_SAFE: Final = frozenset({"GET", "HEAD", "PUT", "DELETE", "OPTIONS"})
"""Sent twice they do what they do once (RFC 9110, section 9.2.2)."""

_LATER: Final = frozenset({429, 502, 503, 504})
_UNTOUCHED: Final = frozenset({429, 503})
"""Answers that say that nothing was begun."""


class Retrying(httpx2.BaseTransport):
    """Sends a request again: any that never reached the service, safe ones, and such as were refused unbegun.

    An upload is streamed from its file and cannot be sent again from its middle; one that was refused is for
    the caller to repeat, which does no harm: the same bytes are the same photo.
    """

    def __init__(
        self,
        retries: int = RETRIES,
        transport: httpx2.BaseTransport | None = None,
        *,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._retries, self._sleep = retries, sleep
        self._transport = transport or httpx2.HTTPTransport()

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """Send, and send again as often as is allowed."""
        for attempt in range(self._retries):
            pause = FIRST_PAUSE_S * 2**attempt
            try:
                answer = self._transport.handle_request(request)
            except httpx2.TransportError as error:
                if request.method not in _SAFE and not isinstance(error, httpx2.ConnectError):
                    raise
            else:
                requested_s = _seconds(answer.headers.get("Retry-After"))
                if not _again(request, answer.status_code) or (requested_s or 0.0) > LONGEST_PAUSE_S:
                    return answer
                answer.close()
                pause = pause if requested_s is None else requested_s
            self._sleep(pause)
        return self._transport.handle_request(request)

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()


def _again(request: httpx2.Request, status: int) -> bool:
    if request.method in _SAFE:
        return status in _LATER
    return status in _UNTOUCHED and isinstance(request.stream, httpx2.ByteStream)


def _seconds(text: str | None) -> float | None:
    return float(text) if text is not None and text.isdigit() else None
