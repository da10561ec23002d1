"""What a PSF costs over HTTP, and when a new version is seen; prints the table of docs/lab/lens-model.md.

    python -m app.lab.psf_service [--requests 400] [--photos 6] [--processes 3] [--size 55] [--busy 0]

Several API processes, as `lensmodel serve` starts them, serve one database with one simulated lens that a
worker has learned. Its samples are true kernels of a lens of third order with the spectra of patches behind
them, so that the wavefront answers too; its share is printed, and none ends the benchmark. One client asks
each of them over a connection that stays open, for a new place every time. Gross is the wall time of a
request seen by the client; net is what remains of it after that of `/healthz` on the same connection: the
share of HTTP, framework and client. The CPU time is the server's, by request. `--busy` lets so many tasks
of a worker compute meanwhile. Then a photo joins the lens, and the very next answer of every process must
be of the new version.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

from app.blobs.storage import Storage
from app.runtime import server
from app.runtime.settings import Settings
from app.runtime.supervisor import ONE_THREAD, environment
from app.store import LensName, NewPatch, NewSample, Store
from app.store.ids import new_id
from app.store.upkeep import migrate
from app.store.versions import learned_key
from lensmodel.core.psf import PsfSample, resized, rms_width
from lensmodel.core.spectrum import PatchSpectrum
from lensmodel.core.types import CHANNELS, FieldPosition, Kernel, LensSettings, NoiseModel, Plane
from lensmodel.lab.model.model_benchmark import patch_places
from lensmodel.lab.scenes import dead_leaves
from lensmodel.model import LensModel
from lensmodel.simulate import SimulatedLens, draw_lens

SIDE, SEED, READY_S = 31, 0, 60.0  # pixels of an estimate; of the lens; longest wait for an answer (chosen)
PATCH, NOISE, TRUTH = 128, 0.003, 41
"""Side of the patches in pixels, standard deviation of their noise, side of the kernels that blur them."""


@dataclass(frozen=True, slots=True)
class Member:
    """One API process and a connection to it that stays open."""

    process: subprocess.Popen[bytes]
    http: http.client.HTTPConnection

    def get(self, path: str) -> bytes:
        """Return a body; anything but 200 ends the benchmark."""
        try:
            self.http.request("GET", path)
            answer = self.http.getresponse()
        except http.client.RemoteDisconnected:  # it has waited for too long: connect again
            self.http.close()
            self.http.request("GET", path)
            answer = self.http.getresponse()
        body = answer.read()
        if answer.status != http.client.OK:
            raise SystemExit(f"{path}: {answer.status} {body[:300]!r}")
        return body

    def cpu_s(self) -> float:
        """CPU time of the process so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def count_photo(store: Store, lens: SimulatedLens, rng: np.random.Generator) -> str:
    """Let a photo of true kernels join the lens, as a worker does; return the id of the lens."""
    public_id = new_id()
    photo = store.photos.receive(
        "local",
        public_id=public_id,
        sha256=f"{rng.integers(2**60):064x}",
        filename="p.dng",
        kind="dng",
        byte_size=1000,
        blob_key=f"photos/{public_id}/original",
        calibrate=True,
        given={},
    ).photo
    store.photos.set_state(public_id, ("received",), "inspecting")
    name = LensName("Simulated", "Lens", "1", "exif")
    store.photos.record_inspection(
        public_id,
        width=4256,
        height=2832,
        identity=name,
        aperture=lens.at_focal().f_number,
        focal_mm=lens.focal_mm[0],
        focus_m=None,
        pixel_pitch_um=4.5,
    )
    row = store.photos.assign_lens(public_id)
    assert row is not None
    store.photos.set_state(public_id, ("inspecting",), "selecting")
    places = patch_places(rng)
    store.patches.add(
        public_id,
        photo.epoch,
        [NewPatch(k, 0, 0, 192, p.r, p.phi, cell=k, score=1.0) for k, p in enumerate(places)],
    )
    store.photos.set_state(public_id, ("selecting",), "estimating")
    settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
    samples = []
    for k, p in enumerate(places):
        scene = dead_leaves(PATCH + TRUTH - 1, PATCH + TRUTH - 1, rng, oversampling=1)
        for number, channel in enumerate(CHANNELS):
            asked = settings.with_channel(channel)
            blur = lens.kernel(p, asked, TRUTH)
            seen = spectrum_behind(blur, scene[number], rng)
            sample = PsfSample(resized(blur, SIDE), p, asked, estimator="default/7", spectrum=seen)
            samples.append(NewSample(k, sample))
    store.patches.finish(public_id, photo.epoch, samples)
    assert store.photos.finish(public_id, photo.epoch) is not None
    return row.public_id


def spectrum_behind(blur: Kernel, scene: Plane, rng: np.random.Generator) -> PatchSpectrum:
    """Spectrum of a patch of a scene behind a kernel, with noise."""
    patch = signal.fftconvolve(scene, blur, mode="valid")
    noisy = (patch + rng.normal(0.0, NOISE, patch.shape)).astype(np.float32)
    return PatchSpectrum.of(noisy, NoiseModel.white(NOISE), rms_width(blur))


def learn(store: Store, storage: Storage, lens_id: str) -> tuple[int, float]:
    """Fit the newest version wholly, as a worker does.

    Returns
    -------
    samples : int
    share : float
        Of the wavefront in an answer of the middle of the field, which HTTP does not tell.
    """
    state, stored = store.samples.of_lens(lens_id)
    model = LensModel.fit([one.sample for one in stored]).warmed()
    storage.put(learned_key(lens_id, state.version, state.rebuild_epoch), model.learned())
    answer = model.query(FieldPosition(0.5, 0.5), stored[0].sample.settings, SIDE)
    return len(stored), answer.wavefront_share


BUSY = """
import os
import numpy as np
from app.sandbox.child import NICENESS, give_way
os.setsid()
give_way(NICENESS)
print("busy", flush=True)
while True:
    np.fft.rfft2(np.ones((512, 512)))
"""
"""What computes as a task of a worker does: in a session of its own, and giving way as far."""


@contextmanager
def busy(tasks: int) -> Iterator[None]:
    """Let processes compute as a worker's tasks do."""
    processes = [
        subprocess.Popen(  # noqa: S603 - our own words
            [sys.executable, "-c", BUSY], env=os.environ | ONE_THREAD, stdout=subprocess.PIPE
        )
        for _ in range(tasks)
    ]
    try:
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


@contextmanager
def serving(settings: Settings, processes: int) -> Iterator[list[Member]]:
    """Start API processes, each on a port of its own, and end them afterwards."""
    with contextlib.ExitStack() as stack:
        members = []
        for _ in range(processes):
            listener = stack.enter_context(server.listen("127.0.0.1", 0))
            number = listener.fileno()
            process = subprocess.Popen(
                [sys.executable, "-m", "app.runtime.api_main"],
                env=os.environ | environment(settings) | ONE_THREAD | {server.SOCKET: str(number)},
                pass_fds=(number,),
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            host, port = listener.getsockname()[:2]
            connection = http.client.HTTPConnection(host, port, timeout=READY_S)
            stack.callback(connection.close)
            members.append(Member(process, connection))
        for member in members:
            member.get("/healthz")
        yield members


def timed(member: Member, paths: Sequence[str]) -> tuple[list[float], float]:
    """Wall milliseconds of each request, and CPU milliseconds of the server by request."""
    cpu, walls_ms = member.cpu_s(), []
    for path in paths:
        start = time.perf_counter()
        member.get(path)
        walls_ms.append(1e3 * (time.perf_counter() - start))
    return walls_ms, 1e3 * (member.cpu_s() - cpu) / len(paths)


def questions(lens_id: str, lens: SimulatedLens, count: int, size: int, suffix: str = "") -> list[str]:
    """Draw addresses of PSFs; no two are of one place."""
    rng, f_number = np.random.default_rng(1), lens.at_focal().f_number
    return [
        f"/v1/lenses/{lens_id}/psf{suffix}?r={r:.6f}&phi={phi:.6f}&size={size}"
        f"&aperture={f_number:g}&focal_length_mm={lens.focal_mm[0]:g}"
        for r, phi in rng.uniform((0.0, -3.1), (0.95, 3.1), (count, 2))
    ]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--requests", type=int, default=400)
    parser.add_argument("--photos", type=int, default=6, help="of 24 patches in three colours")
    parser.add_argument("--processes", type=int, default=3)
    parser.add_argument("--busy", type=int, default=0, metavar="TASKS")
    parser.add_argument("--size", type=int, default=55, help="side of the kernels that are asked for")
    wanted = parser.parse_args()
    lens, rng = draw_lens(SEED), np.random.default_rng(0)
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        settings = Settings(data_dir=Path(folder), log_level="warning")
        store, storage = Store(settings), Storage(settings.storage)
        migrate.upgrade(store.database)
        for _ in range(wanted.photos):
            lens_id = count_photo(store, lens, rng)
        samples, share = learn(store, storage, lens_id)
        if not share:
            raise SystemExit("no wavefront answers: these times would be of the regression alone")
        with serving(settings, wanted.processes) as members, busy(wanted.busy):
            print(
                f"{samples} samples of {SIDE} px, share of the wavefront {share:.2f}, "
                f"answers of {wanted.size} px, "
                f"{wanted.requests} requests, "
                f"{wanted.busy} tasks beside them, load average {os.getloadavg()[0]:.1f}"
            )
            print("| process | answer | gross ms | healthz ms | net ms | server CPU ms | 95 % ms | 99 % ms |")
            print("|---|---|---|---|---|---|---|---|")
            for number, member in enumerate(members):
                for suffix in ("", ".npy"):
                    paths = questions(lens_id, lens, wanted.requests, wanted.size, suffix)
                    timed(member, paths[:20])  # builds the model
                    probe, _ = timed(member, ["/healthz"] * wanted.requests)
                    gross, cpu = timed(member, paths)
                    middle, base = statistics.median(gross), statistics.median(probe)
                    print(
                        f"| {number} | {suffix or 'json'} | {middle:.2f} | {base:.2f} | {middle - base:.2f} "
                        f"| {cpu:.2f} | {np.percentile(gross, 95):.2f} | {np.percentile(gross, 99):.2f} |",
                        flush=True,
                    )
            count_photo(store, lens, rng)
            state = store.samples.state_of(lens_id)
            assert state is not None
            path = questions(lens_id, lens, 1, wanted.size)[0]
            seen = [json.loads(member.get(path))["version"] for member in members]
            print(f"version {state.version} counted; the next answer of each process is of version {seen}")
            if seen != [state.version] * len(members):
                raise SystemExit("an answer was of an old version")
        store.close()


if __name__ == "__main__":
    main()
