r"""Three schedules of Richardson-Lucy at equal quality: none, a fixed one, and that of Biggs and Andrews.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.acceleration --seeds 0 1 2 4 [--steps 100]

Windows of 256 pixels of photographs of the development half are blurred with the true PSFs of simulated
lenses in the middle and the corner of the field, with the noise of a sensor of 50,000 electrons (base ISO),
2,500 (high ISO), or hardly any, and deconvolved with the same PSF by `SaturationAwareRichardsonLucy`. For
each number of steps the PSNR against the sharp window is measured. Equal quality is, of each window, the
PSNR that the worst of the three reaches at its best, less 0.05 dB: printed are the steps and the CPU time
that each takes to get there, over those of the fixed schedule (geometric means over pairs), the best PSNR,
and those after 20 and 25 steps: a method takes a fixed number of them.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, Plane
from lensmodel.correction import SaturationAwareRichardsonLucy, Sensor
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.methods.richardson_lucy import ACCELERATIONS, Acceleration
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.simulate import draw_lens, load_scene

NOISES: Final = {"hardly any": 5e6, "base ISO": 50_000.0, "high ISO": 2_500.0}
"""Electrons at saturation."""

PLACES: Final = {"center": FieldPosition(0.1, 0.5), "corner": FieldPosition(0.9, 2.4)}
"""Where blur is least and where it is most (chosen)."""

WINDOW: Final = 256  # pixels (chosen): several kernels wide
SHOWN_STEPS: Final = (20, 25)  # as many as methods take (chosen)
READ_SHARE: Final = 1e-3  # read noise over full range (chosen)
_KERNEL: Final = 31  # pixels: that of an estimate
_LESS_DB: Final = 0.05  # below what counts as equal (chosen)
_REPEATS: Final = 3  # of a timing, of which the fastest counts (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class TrialWindow:
    """One window to deconvolve."""

    noise: str
    place: str
    blurred: Plane
    sharp: Plane
    blur: UniformBlur
    sensor: Sensor

    def restored(self, acceleration: Acceleration, steps: int) -> Plane:
        """Deconvolve it."""
        method = SaturationAwareRichardsonLucy(steps, acceleration=acceleration)
        return method.deconvolve(self.blurred, self.blur, sensor=self.sensor).plane

    def psnr(self, acceleration: Acceleration, steps: int) -> float:
        """PSNR in dB of linear light, without a border of half a kernel."""
        rim = (slice(_KERNEL // 2, -(_KERNEL // 2)),) * 2
        error = self.restored(acceleration, steps)[rim] - self.sharp[rim]
        return float(-10.0 * np.log10(np.mean(np.square(error, dtype=np.float64))))

    def seconds_a_step(self, acceleration: Acceleration) -> float:
        """CPU seconds, the least of a few runs."""
        spent = []
        for _ in range(_REPEATS):
            began = time.process_time()
            self.restored(acceleration, SHOWN_STEPS[-1])
            spent.append(time.process_time() - began)
        return min(spent) / SHOWN_STEPS[-1]


@dataclass(frozen=True, slots=True)
class ScheduleOutcome:
    """What one schedule comes to on one window."""

    steps: float
    seconds: float
    best_db: float
    after_db: tuple[float, ...]


def windows(seeds: Sequence[int], folder: Path | None = None) -> Iterator[TrialWindow]:
    """Windows of all lenses, places and noises; each lens has a photograph of its own."""
    files = [path for path in list_photos(folder) if photo_half(path.stem) == "dev"]
    for number, seed in enumerate(seeds):
        lens, scene = draw_lens(seed), load_scene(files[number % len(files)])[1]
        top, left = ((n - WINDOW - _KERNEL + 1) // 2 for n in scene.shape)
        latent = np.ascontiguousarray(
            scene[top : top + WINDOW + _KERNEL - 1, left : left + WINDOW + _KERNEL - 1], dtype=np.float32
        )
        for place, position in PLACES.items():
            blur = UniformBlur(lens.kernel(position, LensSettings(channel="g"), _KERNEL))
            clean = np.maximum(blur.forward(latent), 0.0)
            for noise, electrons in NOISES.items():
                rng = np.random.default_rng([seed, int(electrons)])
                grain = np.sqrt(clean / electrons + READ_SHARE**2) * rng.standard_normal(clean.shape)
                yield TrialWindow(
                    noise,
                    place,
                    (clean + grain).astype(np.float32),
                    blur.frame(latent),
                    blur,
                    Sensor(NoiseModel(1.0 / electrons, READ_SHARE**2), clip=np.inf),
                )


def outcomes(window: TrialWindow, most: int) -> dict[Acceleration, ScheduleOutcome]:
    """Follow every schedule over its steps; plain steps are followed three times as long."""
    curves: dict[Acceleration, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    for name in ACCELERATIONS:
        steps = counts(most if name != "none" else 3 * most)
        curves[name] = steps, np.array([window.psnr(name, int(n)) for n in steps])
    wanted = min(float(psnr.max()) for _, psnr in curves.values()) - _LESS_DB
    found: dict[Acceleration, ScheduleOutcome] = {}
    for name, (steps, psnr) in curves.items():
        needed = reached(steps, psnr, wanted)
        after = tuple(float(np.interp(n, steps, psnr)) for n in SHOWN_STEPS)
        found[name] = ScheduleOutcome(needed, needed * window.seconds_a_step(name), float(psnr.max()), after)
    return found


def counts(most: int) -> NDArray[np.float64]:
    """Numbers of steps that are looked at: all up to ten, then about a tenth more each time."""
    found = [1.0]
    while found[-1] < most:
        found.append(min(float(round(max(found[-1] + 1.0, found[-1] * 1.1))), float(most)))
    return np.array(found)


def reached(steps: NDArray[np.float64], psnr: NDArray[np.float64], wanted: float) -> float:
    """Steps after which a curve first reaches a value, interpolated between the two around it."""
    first = int(np.argmax(psnr >= wanted))
    if first == 0:
        return float(steps[0])
    share = (wanted - psnr[first - 1]) / (psnr[first] - psnr[first - 1])
    return float(steps[first - 1] + share * (steps[first] - steps[first - 1]))


def table(found: Sequence[tuple[TrialWindow, dict[Acceleration, ScheduleOutcome]]]) -> str:
    """Rows of noise and schedule, means over windows of all lenses and places."""
    lines = [
        "| noise | schedule | steps to equal quality | over fixed | CPU time over fixed "
        f"| best PSNR | after {' / '.join(map(str, SHOWN_STEPS))} steps | faster than fixed in |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for noise in NOISES:
        rows = [outcome for window, outcome in found if window.noise == noise]
        for name in ACCELERATIONS:
            pairs = [(row[name], row["fixed"]) for row in rows]
            steps = np.exp(np.mean([np.log(a.steps / b.steps) for a, b in pairs]))
            seconds = np.exp(np.mean([np.log(a.seconds / b.seconds) for a, b in pairs]))
            won = sum(a.seconds < b.seconds for a, b in pairs)
            lines.append(
                f"| {noise} | {name} | {np.median([a.steps for a, _ in pairs]):.1f} | {steps:.2f} "
                f"| {seconds:.2f} | {np.mean([a.best_db for a, _ in pairs]):.2f} dB "
                f"| {' / '.join(f'{db:.2f}' for db in np.mean([a.after_db for a, _ in pairs], axis=0))} dB "
                f"| {'-' if name == 'fixed' else f'{won} of {len(pairs)}'} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 4])
    parser.add_argument("--steps", type=int, default=100, help="how long a curve is followed")
    wanted = parser.parse_args()
    data = os.environ.get("LENSMODEL_TEST_DATA")
    folder = None if data is None else Path(data) / "sharp"
    found = [(window, outcomes(window, wanted.steps)) for window in windows(wanted.seeds, folder)]
    print(table(found))


if __name__ == "__main__":
    main()
