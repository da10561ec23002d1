"""The processes of the service: an API, a worker, and `lensmodel serve`, an API with a worker as its child.

These two end together. Starting the service again after one of them died is left to whoever started it:
systemd or a container engine (docs/topics/operating.md). Nothing is lost meanwhile: work goes on where the
tables say.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import uvicorn

from app.runtime import logs
from app.runtime.settings import PREFIX, Settings
from app.sandbox import confine
from app.store.accounts import Accounts
from app.store.database import Database, upgrade
from lensmodel.cli.console import InterruptedByUser, UsageError
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically

log = logging.getLogger(__name__)

# Connections at once; more get 503 (chosen): fewer than the files that a process may have open
MAX_CONNECTIONS: Final = 1000
# How long open requests may take after the order to stop (chosen), and then the worker (chosen): less than a
# command that was interrupted may take (`lensmodel.cli.console`)
GRACE_S: Final = 5
STOP_S: Final = 8.0
WORKER = "app.runtime.worker_main"  # module of the worker; tests replace it


def serve(settings: Settings) -> int:
    """Run the whole service until SIGTERM or Ctrl-C; return the exit status."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    file = settings.data_dir / "service.json"  # the address of the service and the ids of its processes
    with alone(settings.data_dir), contextlib.closing(listen(settings.host, settings.port)) as listener:
        _prepare(settings, api=True, worker=True)
        host, port = listener.getsockname()[:2]
        url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
        worker = subprocess.Popen(  # noqa: S603 - our own interpreter, our own module
            [sys.executable, "-m", WORKER],
            env=os.environ | environment(settings) | {confine.PARENT: str(os.getpid())},
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C reaches this process alone, which stops it
        )
        try:
            text = json.dumps({"url": url, "pid": os.getpid(), "worker_pid": worker.pid}, indent=2)
            write_atomically(file, (text + "\n").encode())
            address = f"lensmodel runs at {url}  (data in {settings.data_dir.resolve()})"
            run(settings, listener, until=worker, announce=lambda: print(address, flush=True))  # noqa: T201
            if worker.poll() is not None:
                log.error("the worker ended with status %d, and with it the service", worker.returncode)
        except InterruptedByUser:
            return 0
        finally:
            worker.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.wait(STOP_S)
            worker.kill()
            worker.wait()
            # gone, or of another service, where the folder was deleted meanwhile
            if file.exists() and json.loads(file.read_bytes())["pid"] == os.getpid():
                file.unlink()
    return 1


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Refuse a second service on a data folder; the lock ends with its process, however that ends."""
    with (folder / "service.lock").open("w", encoding="ascii") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"lensmodel already runs with the data in {folder.resolve()}: open the address it printed "
                "(service.json there has it too), or stop it first, or give another folder by --data"
            ) from error
        yield


def run_api(settings: Settings) -> None:
    """Run one API process in this process."""
    _prepare(settings, api=True)
    listener = listen(settings.host, settings.port)
    with contextlib.closing(listener), contextlib.suppress(InterruptedByUser):
        run(settings, listener)


def run_worker(settings: Settings) -> None:
    """Replace this process by a worker."""
    # A new program rather than a call: children import the main module of their parent again, and that of a
    # worker is small for this reason
    _prepare(settings, worker=True)
    os.environ.update(environment(settings))
    os.execv(sys.executable, [sys.executable, "-m", WORKER])  # noqa: S606 - no shell is wanted


class _Announced(uvicorn.Server):
    """A server that says when it is up: what is printed last is what people see."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], object] | None) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then announce it."""
        await super().startup(sockets)
        if self._announce is not None and not self.should_exit:
            self._announce()


def run(
    settings: Settings,
    listener: socket.socket,
    until: subprocess.Popen[bytes] | None = None,
    announce: Callable[[], object] | None = None,
) -> None:
    """Serve until SIGTERM, or until another process ends; log as a service does, `announce` once it is up."""
    logs.begin("api", settings.log_level, settings.log_format)
    from app.main import create_app  # noqa: PLC0415 - a worker need not load the application

    async def watch() -> None:
        # not `|=`, which would undo what a signal says while the worker is asked
        if until is not None and until.poll() is not None:
            server.should_exit = True

    server = _Announced(
        uvicorn.Config(
            create_app(settings),
            log_level=settings.log_level,
            log_config=None,  # its records go to our handlers
            access_log=False,  # the application writes its own, without serials
            timeout_graceful_shutdown=GRACE_S,
            limit_concurrency=MAX_CONNECTIONS,
            callback_notify=watch,
            timeout_notify=0,  # each second
        ),
        announce,
    )
    server.run(sockets=[listener])


def _prepare(settings: Settings, *, api: bool = False, worker: bool = False) -> None:
    """Bring the schema up to date; check what an API and a worker must have here."""
    confine.keep_private()
    if worker:
        require_sandbox(settings)
    with contextlib.closing(Database(settings.database)) as database:
        upgrade(database)  # one of several simultaneous processes does it
        if not (api and settings.needs_keys) or Accounts(database).has_valid_key():
            return
    raise UsageError(
        f"the service asks for keys (LENS_HOST={settings.host}, LENS_ALLOWED_HOSTS={settings.allowed_hosts}, "
        f"LENS_AUTH={settings.auth}) and there is no valid key yet: make one by `lensmodel keys create "
        "--owner NAME` with the same settings, or listen on 127.0.0.1 without LENS_ALLOWED_HOSTS"
    )


_REMEDIES: Final = {
    "account": "no account to change to: start as root, or with the capabilities SETUID, SETGID, KILL, and "
    "make an account lens-task that can read the program (the container image has one)",
    "files": "no Landlock: use Linux 5.13 or newer with it switched on (lsm=landlock,...), and a container "
    "engine that allows its system calls",
}


def require_sandbox(settings: Settings) -> None:
    """Refuse to start where children must be kept from other files, and something for that is missing."""
    if not settings.needs_sandbox:
        return
    in_force = confine.available(settings.task_user, settings.data_dir)
    missing = [remedy for name, remedy in _REMEDIES.items() if not in_force[name]]
    if missing:
        raise UsageError(
            f"nothing would keep a hostile photo from the photos of others: {'; '.join(missing)}; or accept "
            "that by LENS_SANDBOX=try"
        )


def environment(settings: Settings) -> dict[str, str]:
    """Return the settings as the environment of another process."""
    values = settings.model_dump(mode="json")
    values["data_dir"] = str(settings.data_dir.resolve())
    return {f"{PREFIX}{name.upper()}": str(value) for name, value in values.items()}


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket; port 0 takes a free one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        raise InvalidInputError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; "
            "give another --port (0 takes any free one) or --host"
        ) from error
    # connections inherit it: else the body of a short answer may wait 40 ms for a receipt of its head
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener
