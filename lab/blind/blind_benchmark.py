"""How well blind methods find lens blur, and whether deblurring with their kernels helps.

The protocol of the lens-blur benchmark in the paper (section 5.1, figure 2): sharp photographs,
measured-like lens PSFs, 1 percent noise, and the error ratio of A. Levin et al., "Understanding
and evaluating blind deconvolution algorithms", CVPR 2009::

    ER = | x(k_estimated) - x_true |² / | x(k_true) - x_true |²

where x(k) is the same non-blind deconvolution for both kernels. For mild blur the untouched image
already has an ER of 2 to 4, so each case also tells whether the method beats doing nothing.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lab.blind.judges import Judge, judges, squared_error
from lab.blind.methods import compared
from lab.blind.results import UNTOUCHED, BlindBenchmark, BlindReport, CaseResult, summarised
from lab.blind.store import ResultStore
from lab.cases import BlindCase, list_photos, load_psfs, make_cases, observe
from lensmodel.core import psf
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.registry import Registry
from lensmodel.core.types import Kernel, StepHook, ignore_step
from lensmodel.estimation import PsfEstimator

logger = logging.getLogger(__name__)


def run_blind_benchmark(
    settings: BlindBenchmark,
    *,
    workers: int = 1,
    cache: Path | None = None,
    methods: Registry[PsfEstimator] | None = None,
    only: Collection[str] | None = None,
    on_step: StepHook = ignore_step,
) -> BlindReport:
    """Run the benchmark; what the cache folder already holds is not computed again.

    Parameters
    ----------
    settings : BlindBenchmark
        What to run.
    workers : int
        Processes; the numbers do not depend on it.
    cache : Path or None
        Folder for finished results, one line of JSON each, keyed by the content of photo, PSF,
        method and settings. A run that was stopped goes on from there.
    methods : Registry of PsfEstimator or None
        Where the method names are looked up; None means `methods.compared`.
    only : collection of str or None
        Names of photographs, without suffix; cases that begin with another one are left out.
    on_step : StepHook
        Called after each case.

    Raises
    ------
    UnknownMethodError
        If there is no method or judge of a name.
    InvalidInputError
        If there are no photos or PSFs.
    """
    registry = compared if methods is None else methods
    chosen = {name: registry.create(name) for name in settings.methods}
    judge = judges.create(settings.judge)
    photos, kernels = list_photos(settings.photos), load_psfs(settings.psfs)
    cases = [
        case
        for noise in settings.noise
        for case in make_cases(
            photos,
            len(kernels),
            half=settings.half,
            noise=noise,
            patch=settings.patch,
            variant=settings.variant,
            pool=settings.pool,
            seed=settings.seed,
            limit=settings.cases,
            choice=settings.selection,
            scenes=settings.scenes,
        )
        if only is None or case.photos[0].stem in only
    ]
    store = ResultStore(cache, photos, settings, judge)
    jobs = []
    for case in cases:
        kernel = kernels[case.psf_number]
        missing = {
            name: method
            for name, method in {UNTOUCHED: None, **chosen}.items()
            if store.find(case, kernel, name, method) is None
        }
        if missing:
            jobs.append(_Job(case, kernel, missing, judge, settings.kernel_size))
    done = len(cases) - len(jobs)
    for job, fresh in _run(jobs, workers):
        for result in fresh:
            store.add(job.case, job.kernel, job.methods[result.method], result)
        done += 1
        on_step(done, len(cases))
    found = [
        store.find(case, kernels[case.psf_number], name, method)
        for case in cases
        for name, method in {UNTOUCHED: None, **chosen}.items()
    ]
    results = tuple(result for result in found if result is not None)
    return BlindReport(settings, summarised(results), results)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """One case and the methods that have no result yet; what a worker process receives."""

    case: BlindCase
    kernel: Kernel
    methods: Mapping[str, PsfEstimator | None]
    judge: Judge
    kernel_size: int


def _run(jobs: Sequence[_Job], workers: int) -> Iterator[tuple[_Job, list[CaseResult]]]:
    if workers <= 1:
        for job in jobs:
            yield job, _run_job(job)
        return
    # Fresh processes: a fork would inherit locks of the numerical libraries' threads.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        pending = {pool.submit(_run_job, job): job for job in jobs}
        for future in as_completed(pending):
            yield pending[future], future.result()


def _run_job(job: _Job) -> list[CaseResult]:
    seen = observe(job.case, job.kernel)
    sigma = job.case.noise
    reference = job.judge.deconvolve(seen.patches[0], seen.kernel, sigma, (0.0, 0.0))
    floor = max(squared_error(reference, seen.sharp), 1e-12)
    untouched = squared_error(seen.patches[0], seen.sharp) / floor
    results = []
    for name, method in job.methods.items():
        started = time.perf_counter()
        estimate = None
        if method is not None:
            try:
                estimate = method.estimate(
                    seen.patches,
                    [seen.noise] * len(seen.patches),
                    size=job.kernel_size,
                    rng=np.random.default_rng(job.case.seed),
                )
            except NotEnoughEvidenceError as error:
                logger.info("%s declined %s: %s", name, job.case.name, error)
        seconds = time.perf_counter() - started
        kernel = psf.delta(3) if estimate is None else np.asarray(estimate.kernel)
        distance = psf.distance(kernel, seen.kernel)
        ratio = untouched
        if estimate is not None:
            restored = job.judge.deconvolve(seen.patches[0], kernel, sigma, distance.shift)
            ratio = squared_error(restored, seen.sharp) / floor
        results.append(
            CaseResult(
                case=job.case.name,
                method=name,
                noise=sigma,
                error_ratio=ratio,
                untouched_ratio=untouched,
                ncc=distance.ncc,
                rel_l2=distance.rel_l2,
                mtf_rmse=distance.mtf_rmse,
                width_px=psf.rms_width(kernel),
                true_width_px=psf.rms_width(seen.kernel),
                confidence=math.nan if estimate is None else float(estimate.confidence),
                predicted_error=math.nan if estimate is None else float(estimate.predicted_error),
                declined=method is not None and estimate is None,
                seconds=seconds,
            )
        )
    return results
