from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import site
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadline import stretched, until

from app.runtime import logs, supervisor
from app.runtime.settings import Settings
from app.sandbox import confine, runner
from app.sandbox.child import REPORT, Outcome, TaskLimits, outcome_of
from app.sandbox.runner import MAX_SAID, Budget, Sandbox
from lensmodel.cli.console import UsageError

OWN = Path(__file__).parent
HERE = OWN.parent
LIMITS = TaskLimits(memory_mb=512, wall_s=stretched(30))
LITTER = {"scratch_mb": 2, "files": 40}
Run = Callable[..., Outcome]


@pytest.fixture
def sandbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sandbox:
    monkeypatch.syspath_prepend(str(OWN))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(runner, "TASKS_MODULE", "hostile_tasks")
    return Sandbox(tmp_path / "scratch", Budget(2, 2048), cache=tmp_path / "shared")


@pytest.fixture
def run(sandbox: Sandbox) -> Run:
    def run(task: str, *, limits: TaskLimits = LIMITS, **options: Any) -> Outcome:
        arguments = options.pop("arguments", {})
        with sandbox.folder() as folder:
            return sandbox.run(task, arguments, folder=folder, limits=limits, **options)

    return run


def is_gone(pid: int) -> bool:
    try:
        return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def read_pid(path: Path) -> int:
    return int(until(lambda: path.exists() and path.read_text(), within_s=20))


def test_a_task_hands_over_json_and_files_and_sees_nothing_of_the_services_environment(
    sandbox: Sandbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LENS_DATABASE_URL", "postgresql://user:secret@host/db")
    seen: list[tuple[int, ...]] = []
    numbers: Any = {"a": [1, 2], "b": [10, 20]}
    options: Any = {"limits": LIMITS, "on_progress": lambda *step: seen.append(step)}
    with sandbox.folder() as folder:
        outcome = sandbox.run("add", numbers, folder=folder, **options)

        assert outcome.ending == "ok"
        assert np.load(folder / "sum.npy", allow_pickle=False).tolist() == [11, 22]
    assert seen[-1] == (2, 2)
    assert not folder.exists()
    environment = outcome.value["environment"]
    assert "secret" not in str(environment)
    assert environment["OMP_NUM_THREADS"] == "1"
    assert environment["TMPDIR"] == environment["HOME"] == outcome.value["folder"] == str(folder)


@pytest.mark.parametrize("niceness", [10, 0])
def test_a_task_gives_way_to_requests_as_far_as_it_is_told(run: Run, sandbox: Sandbox, niceness: int) -> None:
    sandbox._niceness = niceness

    seen = run("weight").value

    assert seen["nice"] == min(os.getpriority(os.PRIO_PROCESS, 0) + niceness, 19)
    assert not seen["session"] or seen["session"].rstrip().endswith(f"nice {niceness}")


NO_PATCHES = ("error", "no_usable_patches")
MEMORY, TIME, CRASHED = (("memory_limit",) * 2, ("time_limit",) * 2, ("crashed",) * 2)
TOO_MUCH = (("error", "memory_limit"), "2 MiB or 40 files")


@pytest.mark.parametrize(
    ("task", "arguments", "limits", "ending", "words"),
    [
        ("refuse", {}, {}, NO_PATCHES, "nothing sharp in this photo; use another one"),
        ("refuse", {"more": 1_000_000}, {}, NO_PATCHES, "xxx"),
        ("swell", {"mb": 4096}, {}, MEMORY, "512 MiB"),
        ("swell", {"mb": 64}, {}, ("ok", ""), ""),
        ("litter", {"files": 1, "bytes": 8 << 20}, {"file_mb": 4}, MEMORY, ""),
        ("spin", {}, {"wall_s": 0.6}, TIME, "0.6 s"),
        ("spin", {}, {"cpu_s": 1}, TIME, "1 s of processor time"),
        ("crash", {}, {}, CRASHED, "SIGSEGV"),
        ("die", {}, {}, CRASHED, "SIGKILL"),
        ("blunder", {}, {}, ("crashed", "internal_error"), "KeyError"),
        ("litter", {"files": 3, "bytes": 1 << 20}, LITTER, *TOO_MUCH),
        ("litter", {"files": 50, "bytes": 1}, LITTER, *TOO_MUCH),
    ],
)
def test_an_outcome_says_how_a_task_ended_and_why(
    run: Run, task: str, arguments: Any, limits: Any, ending: tuple[str, str], words: str
) -> None:
    start = time.monotonic()

    outcome = run(task, arguments=arguments, limits=replace(LIMITS, **limits))

    assert (outcome.ending, outcome.code) == ending
    assert words in outcome.detail
    assert "nobody thought" not in outcome.detail  # of what went on inside
    assert len(outcome.detail) < 10_000
    assert time.monotonic() - start < stretched(10 if "wall_s" in limits else 20)


def test_open_files_are_limited(run: Run) -> None:
    assert 16 < run("open_files", limits=replace(LIMITS, open_files=64)).value < 64


def test_cancelling_kills_a_child_and_its_children(sandbox: Sandbox, monkeypatch: pytest.MonkeyPatch) -> None:
    # as where the kernel cannot keep it from starting programs
    monkeypatch.setattr(runner, "TASKS_MODULE", "unconfined_tasks")
    with sandbox.folder() as folder:
        pid = folder / "pid"
        outcome = sandbox.run("spawn", {}, folder=folder, limits=LIMITS, wanted=lambda: not pid.exists())
        pids = [read_pid(folder / name) for name in ("own", "pid")]

    assert outcome.ending == "cancelled"
    until(lambda: all(map(is_gone, pids)), within_s=5)


def clean() -> dict[str, str]:
    """Return an environment in which any interpreter of this version finds what this one does."""
    kept = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    folders = [str(OWN), str(HERE.parents[1]), *site.getsitepackages()]
    return kept | {"PYTHONPATH": os.pathsep.join(folders)}


def boxed(data: Path, task: str, program: str = sys.executable, **asked: Any) -> list[str]:
    """Return the command that runs one task in a service of its own."""
    return [program, str(OWN / "boxed.py"), json.dumps({"data": str(data), "task": task, **asked})]


def test_a_child_dies_with_its_killed_parent(tmp_path: Path) -> None:
    parent = subprocess.Popen(boxed(tmp_path, "sleep"), env=clean())
    said = until(lambda: list(tmp_path.glob("scratch/w/*/pid")), within_s=60)
    child_pid = read_pid(said[0])

    parent.kill()
    parent.wait()

    until(lambda: is_gone(child_pid), within_s=2)


def test_the_fork_server_listens_where_files_may_be_made(tmp_path: Path) -> None:
    """In a container whose root is read-only there is nothing but TMPDIR."""
    with tempfile.TemporaryDirectory() as folder:  # short: the address of a socket must be
        environment, command = clean() | {"TMPDIR": folder}, boxed(tmp_path, "refuse")
        *_, address = json.loads(subprocess.check_output(command, env=environment, text=True))

        assert Path(address).is_relative_to(folder)


def probed(data: Path, *, but: Sequence[str] = (), **asked: Any) -> dict[str, str]:
    """Return what a task that a hostile file took over can do, in a service with secrets."""
    secrets = {"LENS_DATABASE_URL": "postgresql://lens:secret@db/lens", "AWS_SECRET_ACCESS_KEY": "secret"}
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        arguments = {"port": listener.getsockname()[1], "but": but}
        command, environment = boxed(data, "probe", arguments=arguments, **asked), clean() | secrets
        said = subprocess.check_output(command, env=environment, text=True, timeout=stretched(240))
    ending, detail, found, _ = json.loads(said)
    assert ending == "ok", detail
    assert (data / "app.db").read_text() == "rows of all owners"
    assert (data / "blobs" / "other").exists()
    return found


def done(found: dict[str, str]) -> set[str]:
    return {name for name, said in found.items() if said.startswith("done")}


ITS_WORK = {"own photo", "own folder", "thread", "import"}


def test_a_task_that_was_taken_over_can_do_nothing_but_its_work(tmp_path: Path) -> None:
    in_force(*(name for name in confine.MEASURES if name != "account"))
    (tmp_path / "data").mkdir()

    found = probed(tmp_path / "data")

    assert done(found) == ITS_WORK | {"own environment"}
    assert "secret" not in found["own environment"]
    assert "LENS_" not in found["own environment"]


@pytest.fixture
def reachable() -> Iterator[tuple[str, Path]]:
    """An interpreter and a data folder that another account of this machine can use."""
    if os.geteuid() != 0:
        pytest.skip("only root changes to other accounts")
    with tempfile.TemporaryDirectory(prefix="lensmodel-", dir="/tmp") as folder:
        data = Path(folder, "data")
        data.mkdir()
        Path(folder).chmod(0o755)
        for program in (sys.executable, "/usr/bin/python3"):
            command = [program, "-m", "app.sandbox.confine", "nobody", str(data)]
            tried = subprocess.run(command, env=clean(), check=False, capture_output=True, text=True)
            if tried.returncode == 0 and "account" in json.loads(tried.stdout):
                yield program, data
                return
        pytest.skip("no interpreter that another account may use has the libraries")


def test_another_account_keeps_a_task_from_all_files_and_processes(reachable: tuple[str, Path]) -> None:
    program, data = reachable
    but = ("become another program",)  # it would

    found = probed(data, program=program, user="nobody", module="account_only_tasks", but=but)

    theirs = {"accounts of the machine", "connect", "send a datagram", "fork", "run a program"}
    assert done(found) == ITS_WORK | theirs  # the other measures are for these


def test_another_account_and_the_other_measures_go_together(reachable: tuple[str, Path]) -> None:
    program, data = reachable

    assert done(probed(data, program=program, user="nobody")) == ITS_WORK


def test_links_that_a_task_leaves_lead_nowhere(sandbox: Sandbox, tmp_path: Path) -> None:
    database = tmp_path / "app.db"
    database.write_text("rows of all owners")

    with sandbox.folder() as folder:
        outcome = sandbox.run("link", {"database": str(database)}, folder=folder, limits=LIMITS)

        assert outcome.ending == "ok"
        assert {path.name for path in folder.rglob("*")} == {"result.json", "inner", "made"}
    assert database.read_text() == "rows of all owners"


def test_a_task_keeps_neither_its_worker_nor_others_waiting(run: Run, sandbox: Sandbox) -> None:
    server = forkserver._forkserver._forkserver_pid
    start = time.monotonic()

    assert run("stutter", limits=replace(LIMITS, wall_s=1.0)).ending == "time_limit"

    assert time.monotonic() - start < stretched(10)
    assert run("add", arguments={"a": 1, "b": 2}).ending == "ok"
    assert forkserver._forkserver._forkserver_pid == server


@pytest.mark.parametrize("how", ["link", "pipe", "nest", "list", "void", "folder"])
def test_a_report_is_read_as_untrusted(sandbox: Sandbox, tmp_path: Path, how: str) -> None:
    other = tmp_path / "other.json"
    other.write_text('{"end": "ok", "value": "of another"}')
    arguments = {"how": how, "other": str(other)}

    with sandbox.folder() as folder:  # a second try has the folder of the first
        outcomes = [sandbox.run("mislead", arguments, folder=folder, limits=LIMITS) for _ in range(2)]

    assert [(outcome.ending, outcome.value) for outcome in outcomes] == [("crashed", None)] * 2


def test_a_database_can_hold_what_a_report_says(tmp_path: Path) -> None:
    said = "half \ud800 of a character and an end\0"
    (tmp_path / REPORT).write_text(json.dumps({"end": "error", "code": said, "text": said}))

    outcome = outcome_of(0, tmp_path, LIMITS)

    assert outcome.code == outcome.detail == "half ? of a character and an end"


@pytest.mark.parametrize(("full", "out_of_memory"), [(True, False), (False, True), (False, False)])
def test_an_outage_is_what_the_machine_lacks_and_not_what_a_child_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: bool, out_of_memory: bool
) -> None:
    disk = shutil.disk_usage(tmp_path)._replace(free=0 if full else 1 << 30)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk)
    kept = partial(outcome_of, folder=tmp_path, limits=LIMITS, out_of_memory=out_of_memory)

    assert kept(-signal.SIGKILL).ending == ("outage" if full or out_of_memory else "crashed")
    for status in (1, os.EX_TEMPFAIL, -signal.SIGSEGV, 0):
        assert kept(status).ending == ("outage" if full else "crashed")


def test_a_path_beneath_a_file_disables_no_measure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_force("files")
    (tmp_path / "library.zip").touch()
    monkeypatch.setenv("PYTHONPATH", f"{confine.__file__}/inner:{tmp_path / 'library.zip'}/inner")

    assert confine.available("none", tmp_path)["files"]


class Entering:
    """Threads that enter a budget, and in which order they did."""

    def __init__(self, budget: Budget) -> None:
        self.budget, self.order = budget, list[str]()

    def enter(self, name: str, memory_mb: int = 10, *, quick: bool = False) -> threading.Thread:
        def share() -> None:
            with self.budget.share(memory_mb, lambda: True, quick=quick):
                self.order.append(name)

        thread = threading.Thread(target=share)
        thread.start()
        return thread


def test_a_task_that_needs_all_memory_runs_alone_and_is_not_starved() -> None:
    entering = Entering(Budget(4, 100))
    with entering.budget.share(60, lambda: True):
        large = entering.enter("large", 1000)
        until(entering.budget._first.locked)
        small = entering.enter("small")
        small.join(0.05)

        assert entering.order == []
    for thread in (large, small):
        thread.join()

    assert entering.order == ["large", "small"]


def test_waiting_for_the_budget_ends_with_the_interest_in_it() -> None:
    budget = Budget(1, 100)
    with budget.share(10, lambda: True), budget.share(10, lambda: False) as entered:
        assert not entered


def test_a_quick_task_goes_before_those_that_wait_already() -> None:
    entering = Entering(Budget(1, 100))
    with entering.budget.share(10, lambda: True):
        threads = [entering.enter("a"), entering.enter("b")]
        until(entering.budget._first.locked)
        threads.append(entering.enter("quick", quick=True))
        until(entering.budget._quick.locked)
    for thread in threads:
        thread.join()

    assert entering.order[0] == "quick"
    assert sorted(entering.order[1:]) == ["a", "b"]


def in_force(*names: str) -> None:
    measures = confine.available("none", Path("/tmp"))
    missing = [name for name in names if not measures[name]]
    if missing:
        pytest.skip(f"this kernel, or this container, has no {', '.join(missing)}")


def test_a_task_can_signal_and_limit_nobody_but_itself(run: Run) -> None:
    in_force("system_calls")
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"]) as other:
        try:
            found = run("sabotage", arguments={"pid": other.pid}).value
        finally:
            other.kill()

    allowed = {name for name, said in found.items() if said == "done"}
    assert allowed == {"own limits", "own signal"}
    assert set(found.values()) == {"done", "EPERM"}


def test_no_file_of_a_task_escapes_the_count_of_its_folder(run: Run) -> None:
    in_force("system_calls")

    assert run("hoard", arguments={"bytes": 1 << 20}).value == []


def test_what_a_task_prints_is_logged_and_looks_like_no_record_of_ours(
    run: Run,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # a service that ran in this process before has left a handler whose stream is closed
    monkeypatch.setattr(logging.getLogger(), "handlers", [caplog.handler])
    with caplog.at_level("INFO", "app.sandbox.runner"):
        assert run("forge").ending == "ok"
        assert run("forge", arguments={"bytes": 10_000_000}).ending == "ok"

    printed = capfd.readouterr()
    assert "all is lost" not in printed.out + printed.err
    records = [record for record in caplog.records if record.name == "app.sandbox.runner"]
    assert [logs.OneRecord().format(record) for record in records[:1]] == [
        "task forge printed:\n    | harmless"
        "\n    | 2026-01-01 00:00:00,000 CRITICAL worker app.jobs.worker: all is lost\n    | \\x1b[2J"
    ]
    assert len(records[1].getMessage()) < 2 * MAX_SAID


def test_a_task_loads_compiled_code_and_saves_none(sandbox: Sandbox, run: Run) -> None:
    in_force("files")
    forkserver._forkserver._stop()  # of another test, which has another cache
    sandbox._serve()
    limits = TaskLimits(memory_mb=2048, wall_s=stretched(60))
    options: Any = {"limits": limits, "arguments": {"cache": str(sandbox.cache)}}

    first = run("compile_one", **options).value
    compiling = "import hostile_tasks; from lensmodel.core.numerics import jit; jit(hostile_tasks._twice)(1)"
    environment = clean() | {"NUMBA_CACHE_DIR": str(sandbox.cache)}
    subprocess.run([sys.executable, "-c", compiling], env=environment, check=True)
    again = run("compile_one", **options).value

    assert (first, again) == (["compiled", "reads"], ["loaded", "reads"])


@pytest.mark.parametrize("missing", ["account", "files"])
def test_a_service_that_asks_for_keys_does_not_start_without_a_sandbox(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confine, "available", lambda *_: {name: name != missing for name in confine.MEASURES})
    open_to_all = Settings(data_dir=tmp_path)
    closed = open_to_all.model_copy(update={"auth": "keys"})

    supervisor.require_sandbox(open_to_all)
    supervisor.require_sandbox(closed.model_copy(update={"sandbox": "try"}))
    with pytest.raises(UsageError, match="LENS_SANDBOX=try"):
        supervisor.require_sandbox(closed)
    with pytest.raises(UsageError, match="account" if missing == "account" else "Landlock"):
        supervisor.require_sandbox(open_to_all.model_copy(update={"sandbox": "require"}))
