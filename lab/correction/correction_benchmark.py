"""How fast photos are corrected, against what one would use instead.

    python -m lab.correction.correction_benchmark --photo FILE [--as-it-is] [--method fast]

prints time and peak memory from file to file, by Linux's own count: of a RAW photo that is made of the
picture FILE, or of FILE itself, with the lens of `lensmodel bench correct`.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special
from skimage import restoration

from lab.images import to_srgb
from lab.kernels import gaussian
from lab.page import table
from lab.peers import Peer, light_numbers, write_raw
from lensmodel import correction
from lensmodel.api import lateral_of
from lensmodel.core.numerics import jit
from lensmodel.core.types import (
    BayerPattern,
    Channel,
    FieldPosition,
    Frame,
    Kernel,
    NoiseModel,
    Planes,
    StepHook,
    ignore_step,
)
from lensmodel.correction.blur import Real, UniformBlur, fast_shape, to_plane, to_spectrum
from lensmodel.photo import develop, write_image

Window = tuple[int, int, int, int] | None

_TILE = 256  # pixels: a tile of the engine
_KERNEL = 25  # pixels: of a blur of 2 px (chosen)


class SoftCorners:
    """A lens for timing: a Gaussian whose standard deviation grows from .7 to 1.8 pixels in the corner."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; red is a little wider, as diffraction makes it."""
        width = 0.7 + 1.1 * position.r**2
        width *= {"r": 1.05, "g": 1.0, "b": 0.97}[channel]
        # Round, and so a product of two profiles: a lens that were slow would be timed with the methods.
        profile = np.diff(special.ndtr((np.arange(size + 1) - size / 2.0) / width))
        return np.asarray(np.outer(profile, profile) / profile.sum() ** 2)


def run_correct_benchmark(
    photo: Planes,
    *,
    cfa: BayerPattern | None = None,
    methods: Sequence[str] = ("fast", "standard", "paper"),
    workers: int = 1,
    repeats: int = 1,
    peers: Sequence[Peer] = (),
    roi: Window = None,
    on_step: StepHook = ignore_step,
) -> dict[str, Any]:
    """Time the methods on a photo or a part of it, the Richardson-Lucy step, and installed peers."""
    noise = [NoiseModel(1 / 50_000, 1e-6)] * 3
    part = photo[:, *correction.window_of(Frame(*photo.shape[1:]), roi)]
    small = np.ascontiguousarray(photo[:, :200, :200])
    total = len(methods) + 1 + len(peers)
    results: dict[str, dict[str, float]] = {}

    def timed(light: Planes, method: correction.Deconvolver, part: Window) -> list[float]:
        wall, cpu = time.perf_counter(), time.process_time()
        correction.correct_planes(
            light, SoftCorners(), Frame(*light.shape[1:]), noise=noise, method=method, cfa=cfa,
            workers=workers, roi=part,
        )  # fmt: skip
        return [time.process_time() - cpu, time.perf_counter() - wall]

    for done, name in enumerate(methods, start=1):
        method = correction.deconvolvers.create(name)
        timed(small, method, None)  # compiling and first-use tables stay out of the figures
        cpu, wall = np.median([timed(photo, method, roi) for _ in range(repeats)], axis=0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        results[name] = {"cpu_s": float(cpu), "wall_s": float(wall), "peak_mib": peak}
        on_step(done, total)
    kernel = _kernel_times()
    others: dict[str, float | None] = {}
    for done, peer in enumerate(peers, start=len(methods) + 1):
        on_step(done, total)
        others[peer.name] = _peer_seconds(peer, part, repeats) if peer.installed else None
    on_step(total, total)
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "megapixels": part[0].size / 1e6,
        "raw": cfa is not None,
        "workers": workers,
        "methods": results,
        "kernel": kernel,
        "peers": others,
    }


def correct_table(report: Mapping[str, Any]) -> str:
    """Tables of a report of `run_correct_benchmark`, in Markdown."""
    methods, per = report["methods"], 3 * report["megapixels"]
    rows = []
    for name, row in methods.items():
        spent = (f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}", f"{row['cpu_s'] / per:.3f}")
        rows.append([name, *spent, f"{row['peak_mib']:.0f}"])
    peers = []
    for name, seconds in report["peers"].items():
        shares = [f"{row['cpu_s'] / max(seconds or 0.0, 1e-3):.2f} of it" for row in methods.values()]
        found = ["not installed", *[""] * len(shares)] if seconds is None else [f"{seconds:.1f}", *shares]
        peers.append([name, *found])
    steps = [[name.replace("_", " "), f"{value:.4f}"] for name, value in report["kernel"].items()]
    parts = [
        f"{report['megapixels']:.2f} megapixels{', RAW' if report['raw'] else ''}, "
        f"workers {report['workers']}; {report['machine']}",
        table(["method", "wall s", "CPU s", "CPU s per megapixel and channel", "memory so far MiB"], rows),
        table(["Richardson-Lucy step", "value"], steps),
    ]
    if peers:
        head = ["program", "CPU s, files left out", *(f"{name} takes" for name in methods)]
        parts.append(table(head, peers))
    return "\n\n".join(parts)


def _peer_seconds(peer: Peer, photo: Planes, repeats: int) -> float:
    """Median CPU seconds of a program's sharpening on a photo."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / ("in.dng" if peer.raw else "in.tif")
        peer.write_input(np.moveaxis(to_srgb(photo), 0, -1).astype(np.float32), source)
        return float(np.median([peer.net_seconds(source, folder) for _ in range(repeats)]))


@jit
def _bare_transforms(plane: Real, pairs: int) -> None:
    """Transform a plane forth and back, and nothing else: the lower bound that a step is compared with."""
    spectrum = np.empty((plane.shape[0], plane.shape[1] // 2 + 1), np.complex64)
    for _ in range(pairs):
        to_spectrum(plane, spectrum)
        to_plane(spectrum, plane)


def _kernel_times() -> dict[str, float]:
    """CPU seconds per megapixel and iteration; ours carries acceleration, clipping and the border."""
    rng = np.random.default_rng(0)
    plane = (0.2 + 0.5 * rng.random((_TILE - _KERNEL + 1, _TILE - _KERNEL + 1))).astype(np.float32)
    blur = UniformBlur(gaussian(_KERNEL, np.eye(2) * 4.0))
    sensor = correction.Sensor(NoiseModel(1 / 50_000, 1e-6), clip=1.0)
    steps, megapixels = 25, plane.size / 1e6
    ours = correction.SaturationAwareRichardsonLucy(steps)
    wide = (0.2 + 0.5 * rng.random((1024, 1024))).astype(np.float32)
    small = blur.kernel.astype(np.float32)
    canvas = np.zeros(fast_shape((_TILE, _TILE)), dtype=np.float32)
    spent = _cpu(
        {
            "ours": lambda: ours.deconvolve(plane, blur, sensor=sensor),
            "scikit_image": lambda: restoration.richardson_lucy(wide, small, num_iter=4),  # type: ignore[no-untyped-call]
            "bare": lambda: _bare_transforms(canvas, 2 * steps),
        }
    )
    own, bare = (spent[name] / steps / megapixels for name in ("ours", "bare"))
    theirs = spent["scikit_image"] / 4 / (wide.size / 1e6)
    ratios = {"share_of_scikit_image": own / theirs, "over_bare_transforms": own / bare}
    return {"ours": own, "scikit_image": theirs, "bare_transforms": bare, **ratios}


def _cpu(works: Mapping[str, Callable[[], object]], repeats: int = 5) -> dict[str, float]:
    """Smallest CPU time of a few runs of each, in turns, after one that warms up."""
    best: dict[str, float] = {}
    for turn in range(repeats + 1):
        for name, work in works.items():
            start = time.process_time()
            work()
            spent = time.process_time() - start
            best[name] = min(best.get(name, np.inf), spent) if turn else np.inf
    return best


def main() -> None:
    """Correct a file, and print the peak after each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photo", type=Path, metavar="FILE", required=True, help="a picture")
    parser.add_argument("--as-it-is", action="store_true", help="correct FILE itself")
    parser.add_argument("--method", default="fast")
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    wanted = parser.parse_args()
    start = time.perf_counter()

    def tell(part: str) -> None:
        status = Path("/proc/self/status").read_text()
        peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
        Path("/proc/self/clear_refs").write_text("5")  # count the peak of the next part anew
        cpu, wall = time.process_time(), time.perf_counter() - start
        print(f"{part}: peak {peak:.0f} MiB, {cpu:.1f} CPU s, {wall:.1f} s", flush=True)

    with tempfile.TemporaryDirectory() as name:
        source = wanted.photo if wanted.as_it_is else Path(name) / "in.dng"
        # In a process of its own, so that its memory does not count here.
        if not wanted.as_it_is:
            if (pid := os.fork()) == 0:
                write_raw(light_numbers(develop(wanted.photo).planes), source)
                os._exit(0)
            os.waitpid(pid, 0)
        tell("start")
        photo = develop(source)
        tell("developed")
        lateral_of(photo)
        corrected = correction.correct_planes(
            photo.planes, SoftCorners(), photo.frame, method=wanted.method, noise=photo.correction_noise,
            clip=photo.clip, cfa=photo.cfa, workers=wanted.workers,
        )  # fmt: skip
        tell("corrected")
        print(f"photo and correction: {2 * corrected.planes.nbytes / 2**20:.0f} MiB", flush=True)
        encoding = photo.encoding
        del photo
        write_image(Path(name) / "out.tif", corrected.planes, encoding, format="tiff16", color_space="same")
        tell("written")


if __name__ == "__main__":
    main()
