"""Connections on which nobody says anything are closed; the server itself waits for ever for a first word."""

from __future__ import annotations

import asyncio
from typing import ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol


class Impatient(H11Protocol):
    """Waits for the head of a request only so long, from the first byte to its last."""

    patience_s: ClassVar[float] = 30.0
    _waiting: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait."""
        super().connection_made(transport)
        self._look()

    def data_received(self, data: bytes) -> None:
        """Go on to wait, unless a request has begun."""
        super().data_received(data)
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._enough()
        super().connection_lost(exc)

    @property
    def _idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _look(self) -> None:
        if not self._idle:
            self._enough()
        elif self._waiting is None:  # never put off: a head that comes byte by byte is late, too
            self._waiting = self.loop.call_later(self.patience_s, self._close)

    def _enough(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _close(self) -> None:
        self._waiting = None
        if self._idle and not self.transport.is_closing():
            self.transport.close()


def impatient(patience_s: float) -> type[Impatient]:
    """Return the protocol with another patience."""
    return type("Impatient", (Impatient,), {"patience_s": patience_s})
