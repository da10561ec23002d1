"""CPU seconds that blind estimators need for one patch of 256 px in one channel.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.blind.speed [--methods default,michaeli-irani] [--cases 4]

Windows of the test half's photographs behind its PSFs, 1 percent noise, kernel side 31. Seconds of all
threads count. The least of `--repeats` runs counts, since other work on the machine only adds. Beside the
seconds stands what the machine needs for a hundred products of 512 x 512 matrices, by which figures of
different machines compare. With `--beside N`, N processes estimate the same windows at the same time: printed
is their CPU time over that of one process alone, which is 1 where estimators do not hinder each other.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lensmodel.estimation import PsfEstimate
from lensmodel.lab.blind.methods import compared
from lensmodel.lab.cases import Observation, list_photos, load_psfs, make_cases, observe


def least(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds of the quickest of several runs."""
    spent = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return min(spent)


def yardstick() -> None:
    """A hundred products of matrices."""
    square = np.random.default_rng(0).standard_normal((512, 512)).astype(np.float32)
    for _ in range(100):
        square @ square


def all_of(name: str, seen: Sequence[Observation], repeats: int) -> list[float]:
    """CPU seconds of each window."""
    method = compared.create(name)

    def estimate(one: Observation) -> PsfEstimate:
        return method.estimate(one.patches, [one.noise], size=31)

    estimate(seen[0])  # tables that are made once
    return [least(partial(estimate, one), repeats) for one in seen]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", default="default,michaeli-irani")
    parser.add_argument("--cases", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--beside", type=int, default=1, help="so many processes at the same time")
    asked = parser.parse_args()
    data = os.environ.get("LENSMODEL_TEST_DATA")
    photos, kernels = list_photos(Path(data) / "sharp" if data else None), load_psfs()
    cases = make_cases(
        photos,
        len(kernels),
        half="test",
        noise=0.01,
        patch=256,
        variant="gaussian",
        pool=1,
        seed=0,
        limit=asked.cases,
    )
    seen = [observe(case, kernels[case.psf_number]) for case in cases]
    print(f"yardstick {least(yardstick, asked.repeats):.2f} s")
    for name in asked.methods.split(","):
        spent = all_of(name, seen, asked.repeats)
        print(f"{name}: median {np.median(spent):.2f} s, most {max(spent):.2f} s", flush=True)
        if asked.beside > 1:
            with ProcessPoolExecutor(asked.beside, mp_context=get_context("spawn")) as pool:
                work = [pool.submit(all_of, name, seen, asked.repeats) for _ in range(asked.beside)]
                beside = [one.result() for one in work]
            print(f"{name}: {asked.beside} processes {np.sum(beside) / asked.beside / sum(spent):.2f} of one")


if __name__ == "__main__":
    main()
