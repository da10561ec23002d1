"""Use a service in every way at once for an hour, and look whether anything grows that must not.

    python tests/app/endurance/load.py [--minutes 60] [--photos 40] [--kill-every 60] [--seed 0]

A service of its own (SQLite, a folder, workers whose estimates are made up) gets uploads, PSF queries,
corrections, cancels, exclusions and deletions from several threads, while its API and worker processes are
killed now and then. The number of photos is kept level, so that memory, open files, files on disk and rows
must level off too: they are printed every tenth of the time. At the end everything must settle, and
`lensmodel doctor` must find nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import programs
from running import LIGHT, Service, running, write_photo
from sqlalchemy import func, select

from app.blobs.storage import Storage
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.tables import PhotoRow, SampleRow

SCENES = 6
PATIENCE_S = 600.0


class Load:
    """What the threads share."""

    def __init__(self, service: Service, photos: list[bytes], level: int, seed: int) -> None:
        self.service, self.photos, self.level = service, photos, level
        self.rng, self.stop = random.Random(seed), threading.Event()
        self.answers, self.faults, self.known = Counter[str](), list[str](), deque[str]()

    def run(self, deed: Callable[[httpx2.Client], None], pause_s: float) -> None:
        """Do one thing again and again until the end."""
        with httpx2.Client(timeout=60.0) as http:
            while not self.stop.is_set():
                with contextlib.suppress(httpx2.HTTPError, IndexError):  # killed under us; nothing there yet
                    deed(http)
                self.stop.wait(self.rng.uniform(0.5, 1.5) * pause_s)

    def ask(self, http: httpx2.Client, method: str, path: str, **options: Any) -> httpx2.Response:
        """Ask, and note what was answered."""
        # at another port in each of its lives
        answer = http.request(method, self.service.http.base_url.join(path), **options)
        self.answers[f"{method} {answer.status_code}"] += 1
        if answer.status_code == 500:
            self.faults.append(f"{method} {path}: {answer.text[:300]}")
        return answer

    def upload(self, http: httpx2.Client) -> None:
        """Send a photo; delete the oldest where there are enough."""
        data = self.rng.choice(self.photos) + os.urandom(8)  # other bytes, same picture
        answer = self.ask(http, "POST", "/v1/photos", files={"file": ("p.dng", data)})
        if answer.status_code == 202:
            self.known.append(answer.json()["id"])
        if len(self.known) > self.level:
            self.ask(http, "DELETE", f"/v1/photos/{self.known.popleft()}")

    def query(self, http: httpx2.Client) -> None:
        """Ask for the PSF of a lens at a random place."""
        for lens in self.ask(http, "GET", "/v1/lenses").json()["items"][:2]:
            place = {"r": self.rng.random(), "phi": self.rng.uniform(-3, 3), "aperture": 2.8}
            self.ask(http, "GET", f"/v1/lenses/{lens['id']}/psf", params=place)

    def change(self, http: httpx2.Client) -> None:
        """Cancel, retry, exclude, include or correct some photo."""
        photo = self.rng.choice(list(self.known))
        deed = self.rng.choice(["cancel", "retry", "correct", True, False])
        if deed == "correct":
            self.ask(http, "POST", "/v1/corrections", json={"photo_id": photo, "method": "fast"})
        elif isinstance(deed, str):
            self.ask(http, "POST", f"/v1/jobs/{photo}/{deed}")
        else:
            self.ask(http, "PATCH", f"/v1/photos/{photo}", json={"excluded": deed})

    def kill(self) -> None:
        """Kill the API or the worker, which ends the service, and start it again as systemd does."""
        name = self.rng.choice(["pid", "worker_pid"])
        with contextlib.suppress(OSError, ValueError, TypeError):  # between two lives
            os.kill(self.service.info()[name], signal.SIGKILL)
            self.answers[f"killed {name}"] += 1
        self.service.process.wait()
        self.service.start()

    def measured(self, store: Store, minute: float) -> dict[str, Any]:
        """Return what must not grow."""
        memory, handles = 0, 0
        for pid in (self.service.info()[name] for name in ("pid", "worker_pid")):
            with contextlib.suppress(OSError):
                memory += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
                handles += len(list(Path(f"/proc/{pid}/fd").iterdir()))
        files, answers = sum(1 for _ in self.service.data.rglob("*")), sum(self.answers.values())
        row = {"minute": round(minute, 1), "answers": answers, "rss_mb": memory >> 20, "open_files": handles}
        with store.database.reading() as session:
            rows = {table.__tablename__: session.scalar(select(func.count(table.id))) for table in COUNTED}
        return {**row, "files": files, **rows}

    def last(self, store: Store, minutes: float, kill_every_s: float) -> None:
        """Go on for some minutes; print what there is every tenth of them."""
        began, killed, printed = time.monotonic(), time.monotonic(), 0
        while (now := time.monotonic()) - began < 60 * minutes:
            if now - killed > kill_every_s:
                killed = now
                self.kill()
            if now - began > printed * 6 * minutes:
                print(json.dumps(self.measured(store, (now - began) / 60)), flush=True)
                printed += 1
            time.sleep(1.0)


COUNTED = (PhotoRow, SampleRow)


def main() -> int:
    """Run for the time that was asked for."""
    wanted = programs.wishes(__doc__, minutes=60.0, photos=40, kill_every=60.0, seed=0)
    with tempfile.TemporaryDirectory() as folder, running(Path(folder) / "data", LIGHT) as service:
        scenes = [write_photo(Path(folder) / f"{k}.dng", k).read_bytes() for k in range(SCENES)]
        settings = Settings(data_dir=service.data, min_free_mb=0)
        store = Store(settings)
        load = Load(service, scenes, wanted.photos, wanted.seed)
        deeds = [(load.upload, 12.0), (load.query, 0.1), (load.change, 3.0)]
        threads = [threading.Thread(target=load.run, args=deed) for deed in deeds]
        for thread in threads:
            thread.start()
        load.last(store, wanted.minutes, wanted.kill_every)
        load.stop.set()
        for thread in threads:
            thread.join()
        end = time.monotonic() + PATIENCE_S
        while (unsettled := sum(store.jobs.load()[0].values())) and time.monotonic() < end:
            time.sleep(1.0)
        findings = examine(settings, store, Storage(settings.storage))
        store.close()
    print(json.dumps({"answers": dict(load.answers), "unfinished": unsettled, "faults": load.faults[:5]}))
    print("\n".join(f"{finding.check}: {finding.subject}: {finding.says}" for finding in findings))
    return 1 if load.faults or unsettled or findings else 0


if __name__ == "__main__":
    sys.exit(main())
