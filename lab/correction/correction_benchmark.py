"""How fast photos are corrected, against what one would use instead."""

from __future__ import annotations

import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special
from skimage import restoration

from lab.compiled_transforms import bare_transforms
from lab.correction.methods import compared
from lab.images import to_srgb
from lab.peers import Peer
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, gaussian
from lensmodel.core.types import (
    BayerPattern,
    Channel,
    FieldPosition,
    Kernel,
    NoiseModel,
    Planes,
    StepHook,
    ignore_step,
)
from lensmodel.correction import Deconvolver, Roi, SaturationAwareRichardsonLucy, Sensor, correct_planes
from lensmodel.correction.blur import UniformBlur, fast_shape

_TILE = 256  # pixels: a tile of the engine
_KERNEL = 25  # pixels: of a blur of 2 px (chosen)


@dataclass(frozen=True, slots=True)
class SoftCorners:
    """A lens for timing: a Gaussian whose width grows from the centre to the corner."""

    center_px: float = 0.7  # standard deviation in pixels
    corner_px: float = 1.8

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; red is a little wider, as diffraction makes it."""
        width = self.center_px + (self.corner_px - self.center_px) * position.r**2
        width *= {"r": 1.05, "g": 1.0, "b": 0.97}[channel]
        # Round, and so a product of two profiles: a lens that were slow would be timed with the methods.
        profile = np.diff(special.ndtr((np.arange(size + 1) - size / 2.0) / width))
        return np.asarray(np.outer(profile, profile) / profile.sum() ** 2)


def run_correct_benchmark(
    photo: Planes,
    *,
    field: PsfField | None = None,
    cfa: BayerPattern | None = None,
    methods: Sequence[str] = ("fast", "standard", "paper"),
    workers: int = 1,
    repeats: int = 1,
    peers: Sequence[Peer] = (),
    roi: tuple[int, int, int, int] | None = None,
    beside: int | None = None,
    on_step: StepHook = ignore_step,
) -> dict[str, object]:
    """Time the methods on a photo, and the Richardson-Lucy kernel against its peers.

    Parameters
    ----------
    photo : Planes, shape (3, height, width)
        Linear light; may be memory-mapped.
    field : PsfField or None
        The lens; None takes `SoftCorners`.
    cfa : BayerPattern or None
        The mosaic of a RAW photo.
    methods : sequence of str
        Names in `methods.compared`.
    workers : int
        Threads.
    repeats : int
        Runs of each method and peer; the median counts.
    peers : sequence of Peer
        Programs to time on the same picture; those that are not installed are named as missing.
    roi : tuple of int or None
        `(top, left, height, width)`: correct only this part, in the cells of the whole photo; peers are
        given it alone.
    beside : int or None
        Threads of a second run of each method beside each of `workers`, so that their CPU times compare.
    on_step : StepHook
        Called after each method and once for the kernels.

    Returns
    -------
    dict
        `machine`, `megapixels`, `raw`, `methods` (CPU and wall seconds, CPU seconds per megapixel and
        channel, CPU time with the threads of `beside` over that with `workers`, largest memory of the
        process so far in MiB), `kernel` (CPU seconds per megapixel and iteration of our tile kernel, of
        scikit-image and of the bare transforms) and `peers` (CPU seconds of each program's sharpening
        alone, or None where it is not installed).

    Raises
    ------
    InvalidInputError
        If the photo is not three planes, or there is no run.
    """
    if repeats < 1:
        raise InvalidInputError(f"repeats must be at least 1, got {repeats}")
    if photo.ndim != 3 or photo.shape[0] != 3:
        raise InvalidInputError(f"photo must be (3, height, width), got {photo.shape}")
    lens = field or SoftCorners()
    noise = [NoiseModel(1 / 50_000, 1e-6)] * 3
    frame = Frame(photo.shape[1], photo.shape[2])
    window = Roi.of(frame, roi)
    part = photo[:, window.top : window.top + window.height, window.left : window.left + window.width]
    megapixels = window.height * window.width / 1e6
    total = len(methods) + 1 + len(peers)
    results: dict[str, dict[str, float]] = {}
    small = np.ascontiguousarray(photo[:, :200, :200])
    for done, method in enumerate(methods, start=1):
        chosen = compared.create(method)
        # Compiling and first-use tables stay out of the figures.
        correct_planes(
            small, lens, Frame(small.shape[1], small.shape[2]), noise=noise, method=chosen, cfa=cfa
        )
        counts = [workers] if beside is None else [workers, beside]

        def run(threads: int, solver: Deconvolver = chosen) -> tuple[float, float]:
            wall, cpu = time.perf_counter(), time.process_time()
            correct_planes(photo, lens, frame, noise=noise, method=solver, cfa=cfa, workers=threads, roi=roi)
            return time.process_time() - cpu, time.perf_counter() - wall

        runs = np.array([[run(count) for count in counts] for _ in range(repeats)])
        cpu, wall = (float(value) for value in np.median(runs[:, 0], axis=0))
        results[method] = {
            "cpu_s": cpu,
            "wall_s": wall,
            "cpu_s_per_mp_channel": cpu / megapixels / 3,
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        if beside is not None:
            results[method]["cpu_beside_over"] = float(np.median(runs[:, 1, 0] / runs[:, 0, 0]))
        on_step(done, total)
    kernel = _kernel_times()
    on_step(len(methods) + 1, total)
    others: dict[str, float | None] = {}
    for done, peer in enumerate(peers, start=len(methods) + 2):
        others[peer.name] = _peer_seconds(peer, part, repeats) if peer.installed else None
        on_step(done, total)
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "megapixels": megapixels,
        "raw": cfa is not None,
        "workers": workers,
        "beside": beside,
        "methods": results,
        "kernel": kernel,
        "peers": others,
    }


def correct_table(report: Mapping[str, Any]) -> str:
    """Tables of a report of `run_correct_benchmark`, in Markdown."""
    lines = [
        f"{report['megapixels']:.2f} megapixels{', RAW' if report['raw'] else ''}, "
        f"workers {report['workers']}; {report['machine']}",
        "",
        "| method | wall s | CPU s | CPU s per megapixel and channel | memory so far MiB |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {row['wall_s']:.2f} | {row['cpu_s']:.2f} | {row['cpu_s_per_mp_channel']:.3f} "
        f"| {row['peak_mib']:.0f} |"
        for name, row in report["methods"].items()
    ]
    lines += [
        f"\n{name}: {report['beside']} threads take {row['cpu_beside_over']:.3f} of the CPU time of these."
        for name, row in report["methods"].items()
        if "cpu_beside_over" in row
    ]
    lines += ["", "| Richardson-Lucy step | value |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {value:.4f} |" for name, value in report["kernel"].items()]
    if report["peers"]:
        names = list(report["methods"])
        shares = "".join(f" {name} takes |" for name in names)
        lines += ["", f"| program | CPU s, files left out |{shares}", "|---|---|" + "---|" * len(names)]
    for peer, seconds in report["peers"].items():
        if seconds is None:
            lines.append(f"| {peer} | not installed |" + " |" * len(names))
            continue
        parts = [report["methods"][name]["cpu_s"] / max(seconds, 1e-3) for name in names]
        lines.append(f"| {peer} | {seconds:.1f} |" + "".join(f" {part:.2f} of it |" for part in parts))
    return "\n".join(lines)


def _peer_seconds(peer: Peer, photo: Planes, repeats: int) -> float:
    """Median CPU seconds of a program's sharpening on a photo."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / ("in.dng" if peer.raw else "in.tif")
        peer.write_input(np.moveaxis(to_srgb(photo), 0, -1).astype(np.float32), source)
        return float(np.median([peer.net_seconds(source, folder) for _ in range(repeats)]))


def _kernel_times() -> dict[str, float]:
    """CPU seconds per megapixel and iteration; ours carries acceleration, clipping and the border."""
    rng = np.random.default_rng(0)
    plane = (0.2 + 0.5 * rng.random((_TILE - _KERNEL + 1, _TILE - _KERNEL + 1))).astype(np.float32)
    blur = UniformBlur(gaussian(_KERNEL, np.eye(2) * 4.0))
    sensor = Sensor(NoiseModel(1 / 50_000, 1e-6), clip=1.0)
    steps, megapixels = 25, plane.size / 1e6

    def ours() -> None:
        SaturationAwareRichardsonLucy(steps).deconvolve(plane, blur, sensor=sensor)

    wide = (0.2 + 0.5 * rng.random((1024, 1024))).astype(np.float32)

    def theirs() -> None:
        restoration.richardson_lucy(  # type: ignore[no-untyped-call]  # scikit-image ships no types
            wide, blur.kernel.astype(np.float32), num_iter=4
        )

    canvas = np.zeros(fast_shape((_TILE, _TILE)), dtype=np.float32)
    works = {
        "ours": ours,
        "scikit_image": theirs,
        "bare_transforms": lambda: bare_transforms(canvas, 2 * steps),
    }
    spent = _cpu(works)
    times = {
        "ours": spent["ours"] / steps / megapixels,
        "scikit_image": spent["scikit_image"] / 4 / (wide.size / 1e6),
    }
    times["share_of_scikit_image"] = times["ours"] / times["scikit_image"]
    times["bare_transforms"] = spent["bare_transforms"] / steps / megapixels
    times["over_bare_transforms"] = times["ours"] / times["bare_transforms"]
    return times


def _cpu(works: Mapping[str, Callable[[], None]], repeats: int = 5) -> dict[str, float]:
    """Smallest CPU time of a few runs of each, in turns, after one that warms up."""
    best: dict[str, float] = {}
    for turn in range(repeats + 1):
        for name, work in works.items():
            start = time.process_time()
            work()
            spent = time.process_time() - start
            best[name] = min(best.get(name, np.inf), spent) if turn else np.inf
    return best
