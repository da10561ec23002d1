"""One API process: uvicorn on a socket of its own, or on that of the supervisor."""

from __future__ import annotations

import os
import socket
from typing import Final

import uvicorn

from app.runtime import logs
from app.runtime.processes import end_with_parent
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
    uvicorn.Server(config).run(sockets=[listener])


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket; port 0 takes a free one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=2048)


if __name__ == "__main__":
    end_with_parent()
    run(Settings(), socket.socket(fileno=int(os.environ.pop(SOCKET))))
