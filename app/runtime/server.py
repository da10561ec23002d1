"""One API process: uvicorn on a socket of its own, or on that of the supervisor."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from typing import Final

import uvicorn

from app.runtime import logs
from app.runtime.processes import end_with_parent, on_signals
from app.runtime.settings import Settings
from app.sandbox import confine

SOCKET: Final = "LENSMODEL_SOCKET"  # environment variable with the file descriptor of the listening socket
# Connections at once; more get 503 (chosen): fewer than the files that a process may have open
MAX_CONNECTIONS: Final = 1000
# How long open requests may take after the order to stop (chosen): less than `supervisor.STOP_S`
GRACE_S: Final = 5


def run(settings: Settings, listener: socket.socket) -> None:
    """Serve until SIGTERM; log as a service does."""
    logs.begin("api", settings.log_level, settings.log_format)
    confine.keep_private()
    from app.main import create_app  # noqa: PLC0415 - the supervisor need not load the application

    config = uvicorn.Config(
        create_app(settings),
        log_level=settings.log_level,
        log_config=None,  # its records go to our handlers
        access_log=False,  # the application writes its own, without serials
        timeout_graceful_shutdown=GRACE_S,
        limit_concurrency=MAX_CONNECTIONS,
    )
    _Server(config).run(sockets=[listener])


class _Server(uvicorn.Server):
    """Exits with status 0 on a signal: uvicorn would raise the signal again afterwards."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Let signals of the process stop the server, and the streams that are open."""
        on_signals(lambda number: self.handle_exit(number, None))
        yield


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket; port 0 takes a free one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(2048)
    except OSError:
        listener.close()
        raise
    return listener


def main() -> None:
    """Serve on the socket that the environment names."""
    end_with_parent()
    settings = Settings()
    number = os.environ.pop(SOCKET, None)
    listener = listen(settings.host, settings.port) if number is None else socket.socket(fileno=int(number))
    run(settings, listener)


if __name__ == "__main__":
    main()
