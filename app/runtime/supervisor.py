"""`lensmodel serve`: one API process and one worker process, which end together.

Starting the service again after one of them died is left to whoever started it: systemd or a container engine
(docs/topics/operating.md). Nothing is lost meanwhile: work goes on where the tables say.
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
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from app.runtime import server
from app.runtime.processes import PARENT
from app.runtime.settings import PREFIX, Settings
from app.sandbox import confine
from app.store import migrate
from app.store.accounts import Accounts
from app.store.database import Database
from lensmodel.cli.ending import InterruptedByUser, UsageError
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically

log = logging.getLogger(__name__)

# How long members may take to stop before they are killed (chosen): longer than `server.GRACE_S`, and less
# than a command that was interrupted may take (`lensmodel.cli.ending`)
STOP_S: Final = 8.0
POLL_S: Final = 0.2  # seconds between two looks at the members (chosen): two calls of waitpid
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
        return _run(settings, listener)


def run_api(settings: Settings) -> None:
    """Run one API process in this process."""
    confine.keep_private()
    _prepare(settings)
    with contextlib.closing(_listener(settings)) as listener, contextlib.suppress(InterruptedByUser):
        server.run(settings, listener)


def run_worker(settings: Settings) -> None:
    """Replace this process by a worker."""
    # A new program rather than a call: children import the main module of their parent again, and that of a
    # worker is small for this reason
    confine.keep_private()
    require_sandbox(settings)
    _prepare(settings, asks_for_keys=False)
    os.environ.update(ONE_THREAD | environment(settings))
    os.execv(sys.executable, [sys.executable, "-m", "app.runtime.worker_main"])  # noqa: S606 - no shell is wanted


def _prepare(settings: Settings, *, asks_for_keys: bool = True) -> None:
    """Bring the schema up to date, and check that there is a key if one is needed."""
    with contextlib.closing(Database(settings.database)) as database:
        migrate.upgrade(database)  # one of several simultaneous processes does it
        if not (asks_for_keys and settings.needs_keys) or Accounts(database).has_valid_key():
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


def _run(settings: Settings, listener: socket.socket) -> int:
    """Run both processes until one of them ends, or the service is told to stop; return the exit status."""
    members: dict[str, subprocess.Popen[bytes]] = {}
    file = settings.data_dir / "service.json"  # the address of the service and the ids of its processes
    host, port = listener.getsockname()[:2]
    url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    try:
        for name, module in (("worker", WORKER), ("api", API)):
            members[name] = _start(settings, listener, module)
        pids = {f"{name}_pid": process.pid for name, process in members.items()}
        text = json.dumps({"url": url, "pid": os.getpid(), **pids}, indent=2)
        write_atomically(file, (text + "\n").encode())
        # it answers once the API is up: connections wait in the socket until then
        print(f"lensmodel runs at {url}  (data in {settings.data_dir.resolve()})", flush=True)  # noqa: T201
        ended: list[str] = []
        while not ended:
            time.sleep(POLL_S)
            ended = [name for name, process in members.items() if process.poll() is not None]
        for name in ended:
            status = members[name].returncode
            log.error("the %s process ended with status %d, and with it the service", name, status)
    except InterruptedByUser:
        return 0
    finally:
        _end(list(members.values()))
        file.unlink(missing_ok=True)
    return 1


def _start(settings: Settings, listener: socket.socket, module: str) -> subprocess.Popen[bytes]:
    inherited = {server.SOCKET: str(listener.fileno()), PARENT: str(os.getpid())}
    return subprocess.Popen(  # noqa: S603 - our own interpreter, our own modules
        [sys.executable, "-m", module],
        env=os.environ | environment(settings) | ONE_THREAD | inherited,
        pass_fds=(listener.fileno(),),
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # a Ctrl-C reaches the supervisor alone, which stops them
    )


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
