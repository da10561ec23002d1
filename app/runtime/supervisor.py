"""`lensmodel serve`: one API process and one worker process, which end together.

Starting the service again after one of them died is left to whoever started it: systemd or a container engine
(docs/topics/operating.md). Nothing is lost meanwhile: work goes on where the tables say.
"""

from __future__ import annotations

import contextlib
import fcntl
import http.client
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from app.runtime import server
from app.runtime.processes import PARENT, on_signals
from app.runtime.settings import PREFIX, Settings
from app.sandbox import confine
from app.store import migrate
from app.store.accounts import Accounts
from app.store.database import Database
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically

log = logging.getLogger(__name__)

POLL_S: Final = 0.1  # seconds between two looks at the members (chosen): two calls of waitpid
# Seconds between two requests of `/readyz` during the start (chosen): few beside a start of some seconds
READY_POLL_S: Final = 0.25
# How long members may take to stop before they are killed (chosen): longer than `server.GRACE_S`
STOP_S: Final = 15.0
# Modules of the members; tests replace the worker
WORKER, API = "app.runtime.worker_main", "app.runtime.server"
ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def serve(settings: Settings) -> int:
    """Run the whole service until SIGTERM or Ctrl-C; return the exit status."""
    confine.keep_private()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    require_sandbox(settings)
    with alone(settings.data_dir), contextlib.closing(_listener(settings)) as listener:
        _prepare(settings)
        return _Supervisor(settings, listener).run()


def run_api(settings: Settings) -> None:
    """Run one API process in this process."""
    confine.keep_private()
    _prepare(settings)
    with contextlib.closing(_listener(settings)) as listener:
        server.run(settings, listener)


def run_worker(settings: Settings) -> None:
    """Replace this process by a worker."""
    # A new program rather than a call: children import the main module of their parent again, and that of a
    # worker is small for this reason
    confine.keep_private()
    require_sandbox(settings)
    _migrate(settings)
    os.environ.update(ONE_THREAD | environment(settings))
    os.execv(sys.executable, [sys.executable, "-m", "app.runtime.worker_main"])  # noqa: S606 - no shell is wanted


def _prepare(settings: Settings) -> None:
    """Bring the schema up to date, and check that there is a key if one is needed."""
    _migrate(settings)
    database = Database(settings.database)
    try:
        usable = not settings.needs_keys or Accounts(database).has_valid_key()
    finally:
        database.close()
    if usable:
        return
    raise UsageError(
        f"the service asks for keys (LENS_HOST={settings.host}, LENS_ALLOWED_HOSTS={settings.allowed_hosts}, "
        f"LENS_AUTH={settings.auth}) and there is no valid key yet: make one by `lensmodel keys create "
        "--owner NAME` with the same settings, or listen on 127.0.0.1 without LENS_ALLOWED_HOSTS"
    )


def require_sandbox(settings: Settings) -> None:
    """Refuse to start where children must be kept from other files, and something for that is missing."""
    if not settings.needs_sandbox:
        return
    in_force = confine.available(settings.task_user, settings.data_dir)
    missing = [remedy for name, remedy in _REMEDIES.items() if not in_force[name]]
    if missing:
        raise UsageError(
            "nothing would keep a hostile photo from the photos of others: "
            + "; ".join(missing)
            + "; or accept that by LENS_SANDBOX=try"
        )


_REMEDIES: Final = {
    "account": "no account to change to: start as root, or with the capabilities SETUID, SETGID, KILL, and "
    "make an account lens-task that can read the program (the container image has one)",
    "files": "no Landlock: use Linux 5.13 or newer with it switched on (lsm=landlock,...), and a container "
    "engine that allows its system calls",
}


def _migrate(settings: Settings) -> None:
    """Bring the schema up to date; one of several simultaneous processes does it."""
    database = Database(settings.database)
    try:
        migrate.upgrade(database)
    finally:
        database.close()


def environment(settings: Settings) -> dict[str, str]:
    """Return the settings as the environment of another process."""
    values = settings.model_dump(mode="json")
    values["data_dir"] = str(settings.data_dir.resolve())
    return {f"{PREFIX}{name.upper()}": str(value) for name, value in values.items()}


def _listener(settings: Settings) -> socket.socket:
    try:
        return server.listen(settings.host, settings.port)
    except OSError as error:
        raise InvalidInputError(
            f"cannot listen on {settings.host}:{settings.port}: {error.strerror or error}; "
            "give another --port (0 takes any free one) or --host"
        ) from error


@contextmanager
def alone(data_dir: Path) -> Iterator[None]:
    """Make sure that only one supervisor works on this folder; the lock ends with the process."""
    with (data_dir / "service.lock").open("w", encoding="ascii") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"another service already works on {data_dir}: stop it, or give another folder by --data"
            ) from error
        yield


@dataclass
class _Supervisor:
    """Starts the members, waits, and stops them."""

    settings: Settings
    listener: socket.socket
    _stopping: threading.Event = field(default_factory=threading.Event)

    def run(self) -> int:
        """Run until stopped, or until one of the members ends; return the exit status."""
        on_signals(self._on_signal)
        members = {name: self._start(module) for name, module in (("worker", WORKER), ("api", API))}
        self._write(members)
        threading.Thread(target=self._announce, daemon=True).start()
        try:
            while not self._stopping.wait(POLL_S):
                for name, process in members.items():
                    status = process.poll()
                    if status is not None:
                        log.error(
                            "the %s process ended with status %d, and with it the service", name, status
                        )
                        return 1
        finally:
            self._stopping.set()
            _end(list(members.values()))
            self._file.unlink(missing_ok=True)
        return 0

    def _on_signal(self, number: signal.Signals) -> None:
        log.info("%s: stopping", number.name)
        self._stopping.set()

    @property
    def _file(self) -> Path:
        return self.settings.data_dir / "service.json"

    @property
    def url(self) -> str:
        """Where the service listens."""
        host, port = self.listener.getsockname()[:2]
        return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

    def _start(self, module: str) -> subprocess.Popen[bytes]:
        inherited = {server.SOCKET: str(self.listener.fileno()), PARENT: str(os.getpid())}
        return subprocess.Popen(  # noqa: S603 - our own interpreter, our own modules
            [sys.executable, "-m", module],
            env=os.environ | environment(self.settings) | ONE_THREAD | inherited,
            pass_fds=(self.listener.fileno(),),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C reaches the supervisor alone, which stops them
        )

    def _write(self, members: Mapping[str, subprocess.Popen[bytes]]) -> None:
        """Write the address of the service and the ids of its processes to a file."""
        pids = {f"{name}_pid": process.pid for name, process in members.items()}
        text = json.dumps({"url": self.url, "pid": os.getpid(), **pids}, indent=2)
        write_atomically(self._file, (text + "\n").encode())

    def _announce(self) -> None:
        """Print the address once the service can be used."""
        host, port = self.listener.getsockname()[:2]
        while not self._stopping.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):
                connection = http.client.HTTPConnection(host, port, timeout=5)
                with contextlib.closing(connection):
                    connection.request("GET", "/readyz")
                    if connection.getresponse().status == http.client.OK:
                        break
            self._stopping.wait(READY_POLL_S)
        else:
            return
        print(f"lensmodel is ready: {self.url}  (data in {self.settings.data_dir.resolve()})", flush=True)  # noqa: T201


def _end(members: list[subprocess.Popen[bytes]]) -> None:
    """Terminate all members; kill those that do not stop in time."""
    for process in members:
        process.terminate()
    end = time.monotonic() + STOP_S
    for process in members:
        try:
            process.wait(max(end - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
