"""How fast photos are corrected, against what one would use instead."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from skimage import restoration

from lensmodel.blur import UniformBlur
from lensmodel.blur.uniform import fast_shape
from lensmodel.deconv import SaturationAwareRichardsonLucy, Sensor, correct_planes
from lensmodel.deconv.engine import compiled
from lensmodel.errors import InvalidInputError
from lensmodel.geometry import Frame
from lensmodel.psf import PsfField, gaussian
from lensmodel.types import Channel, FieldPosition, Kernel, NoiseModel, Planes, StepHook, ignore_step

_TILE = 256
_KERNEL = 25


@dataclass(frozen=True, slots=True)
class SoftCorners:
    """A lens for timing: a Gaussian whose width grows from the centre to the corner.

    Parameters
    ----------
    center_px, corner_px : float
        Standard deviation in pixels.
    """

    center_px: float = 0.7
    corner_px: float = 1.8

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; red is a little wider, as diffraction makes it."""
        width = self.center_px + (self.corner_px - self.center_px) * position.r**2
        return gaussian(size, np.eye(2) * (width * {"r": 1.05, "g": 1.0, "b": 0.97}[channel]) ** 2)


def run_correct_benchmark(
    photo: Planes,
    *,
    field: PsfField | None = None,
    methods: Sequence[str] = ("fast", "standard", "paper"),
    workers: int = 1,
    out: Planes | None = None,
    on_step: StepHook = ignore_step,
) -> dict[str, object]:
    """Time the methods on a photo, and the Richardson-Lucy kernel against its peers.

    Parameters
    ----------
    photo : Planes, shape (3, height, width)
        Linear light; may be memory-mapped.
    field : PsfField or None
        The lens; None takes `SoftCorners`.
    methods : sequence of str
        Names in `deconvolvers`.
    workers : int
        Threads.
    out : Planes or None
        Where results are written; None allocates.
    on_step : StepHook
        Called after each method and once for the kernels.

    Returns
    -------
    dict
        `machine`, `megapixels`, `methods` (CPU and wall seconds, CPU seconds per megapixel and
        channel, largest memory of the process so far in MiB) and `kernel` (CPU seconds per
        megapixel and iteration of our tile kernel, of scikit-image and of the bare transforms).

    Raises
    ------
    InvalidInputError
        If the photo is not three planes.
    """
    if photo.ndim != 3 or photo.shape[0] != 3:
        raise InvalidInputError(f"photo must be (3, height, width), got {photo.shape}")
    lens = field or SoftCorners()
    noise = [NoiseModel(1 / 50_000, 1e-6)] * 3
    frame = Frame(photo.shape[1], photo.shape[2])
    megapixels = frame.height * frame.width / 1e6
    total = len(methods) + 1
    results: dict[str, dict[str, float]] = {}
    small = np.ascontiguousarray(photo[:, :200, :200])
    for done, method in enumerate(methods, start=1):
        # Compiling and first-use tables stay out of the figures.
        correct_planes(small, lens, Frame(small.shape[1], small.shape[2]), noise=noise, method=method)
        wall, cpu = time.perf_counter(), time.process_time()
        correct_planes(photo, lens, frame, noise=noise, method=method, workers=workers, out=out)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        results[method] = {
            "cpu_s": cpu,
            "wall_s": wall,
            "cpu_s_per_mp_channel": cpu / megapixels / 3,
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        on_step(done, total)
    kernel = _kernel_times()
    on_step(total, total)
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "megapixels": megapixels,
        "workers": workers,
        "methods": results,
        "kernel": kernel,
    }


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

    times = {
        "ours": _cpu(ours) / steps / megapixels,
        "scikit_image": _cpu(theirs) / 4 / (wide.size / 1e6),
    }
    times["share_of_scikit_image"] = times["ours"] / times["scikit_image"]
    loops = compiled("auto")
    if loops is not None:
        canvas = np.zeros(fast_shape((_TILE, _TILE)), dtype=np.float32)
        times["bare_transforms"] = _cpu(lambda: loops.bare_transforms(canvas, 2 * steps)) / steps / megapixels
        times["over_bare_transforms"] = times["ours"] / times["bare_transforms"]
    return times


def _cpu(work: Callable[[], None], repeats: int = 5) -> float:
    """Smallest CPU time of a few runs, after one that warms up."""
    work()
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return float(best)
