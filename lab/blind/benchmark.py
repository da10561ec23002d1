"""How well blind methods find lens blur, and whether deblurring with their kernels helps.

The protocol of section 5.1 of the paper, with the error ratio of A. Levin et al., "Understanding and
evaluating blind deconvolution algorithms", CVPR 2009; x(k) is the same non-blind deconvolution of both::

    ER = | x(k_estimated) - x_true |² / | x(k_true) - x_true |²
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, is_dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from lab import kernels
from lab.blind.judge import deconvolved, squared_error
from lab.blind.methods import BlindMethod, compared
from lab.cases import BlindCase, Half, list_photos, load_psfs, make_cases, observe
from lab.page import table
from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.registry import Registry
from lensmodel.core.types import Kernel, StepHook, ignore_step

logger = logging.getLogger(__name__)

PROTOCOL = 4  # part of every cache key; raised when cases, their windows, metrics or the judge change
KERNEL_SIZE: Final = 31  # pixels of an estimate: odd
UNTOUCHED = "none"  # the method that does nothing: the baseline of every table


@dataclass(frozen=True, slots=True)
class BlindBenchmark:
    """What to run."""

    photos: Path | None = None  # folder of sharp photographs; None means those of the library
    noise: tuple[float, ...] = (0.01,)  # standard deviations as shares of full range
    methods: tuple[str, ...] = ("default",)  # names of blind estimators; "none" is always added
    half: Half = "test"  # which half of photos and PSFs
    cases: int | None = None  # at most so many, spread over photos and PSFs
    patch: int = 256  # sides in pixels
    scenes: int | None = None  # so many windows of the photographs in turn; None means one of each

    def __post_init__(self) -> None:
        if not all(1e-4 <= s <= 0.2 for s in self.noise):
            raise InvalidInputError(f"noise must lie in 0.0001..0.2, got {self.noise}")


@dataclass(frozen=True, slots=True)
class CaseResult:
    """One method on one case."""

    case: str
    method: str
    noise: float
    error_ratio: float  # ER with the estimated kernel, and of the blurred patch as it is
    untouched_ratio: float
    ncc: float  # against the true kernel after sub-pixel alignment; see `lab.kernels.distance`
    rel_l2: float
    mtf_rmse: float
    width_px: float  # RMS widths
    true_width_px: float
    declined: bool  # the estimator gave no answer; the patch then stays as it is
    seconds: float  # of the estimate alone

    @property
    def improved(self) -> bool:
        """Whether deblurring with the estimate beats doing nothing."""
        return self.error_ratio < self.untouched_ratio


@dataclass(frozen=True, slots=True)
class BlindReport:
    """Outcome of a run: the settings, and every case."""

    settings: BlindBenchmark
    results: tuple[CaseResult, ...]

    def to_json(self) -> str:
        """Return settings, summary and cases; NaN becomes null."""
        whole = {
            "protocol": PROTOCOL,
            "settings": asdict(self.settings),
            "summary": [plain(row) for row in summarised(self.results)],
            "cases": [{**plain(asdict(row)), "improved": row.improved} for row in self.results],
        }
        return json.dumps(whole, indent=1, default=str) + "\n"


def summarised(results: Sequence[CaseResult]) -> list[dict[str, Any]]:
    """One row a method and noise level: shares of all cases, medians, and the 90th percentile of ER."""
    groups: dict[tuple[float, str], list[CaseResult]] = {}
    for result in results:
        groups.setdefault((result.noise, result.method), []).append(result)
    rows = []
    medians = ("ncc", "rel_l2", "mtf_rmse", "seconds")
    for (noise, method), own in groups.items():
        ratios = np.array([row.error_ratio for row in own])
        widths = [row.width_px / row.true_width_px if row.true_width_px else math.nan for row in own]
        rows.append(
            {
                "method": method,
                "noise": noise,
                "cases": len(own),
                "improved": float(np.mean([row.improved for row in own])),
                "er_lt_3": float((ratios < 3.0).mean()),
                "er_lt_2": float((ratios < 2.0).mean()),
                "er_median": float(np.median(ratios)),
                "er_p90": float(np.percentile(ratios, 90.0)),
                "width_ratio": float(np.median(widths)),
                **{name: float(np.median([getattr(row, name) for row in own])) for name in medians},
            }
        )
    return rows


def plain(row: Mapping[str, object]) -> dict[str, object]:
    """Return a row with None for what is no finite number, as JSON wants it."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def key_of(case: BlindCase, content: str, kernel: Kernel, name: str, method: BlindMethod | None) -> str:
    """Hash of all that a result depends on; `content` is that of the photograph."""
    parts = (
        PROTOCOL,
        content,
        case.photo.stem,  # of which the noise is drawn
        hashlib.sha256(np.ascontiguousarray(kernel).tobytes()).hexdigest(),
        (case.psf_number, case.noise, case.patch, case.seed, case.window),
        (name, getattr(method, "version", 0), changed(method), KERNEL_SIZE),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def changed(method: object) -> dict[str, object]:
    """Settings of a method that are not its defaults; so results outlive a setting that is taken away."""
    own = fields(method) if is_dataclass(method) else ()
    return {f.name: value for f in own if f.repr and (value := getattr(method, f.name)) != f.default}


def _stored(file: Path) -> Iterator[tuple[str, CaseResult]]:
    names = [field.name for field in fields(CaseResult)]
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            values: Any = {name: math.nan if row[name] is None else row[name] for name in names}
            yield row["key"], CaseResult(**values)
        except (ValueError, KeyError, TypeError):
            # The last line of a run that was killed while writing.
            logger.warning("skipped a damaged line of %s", file)


def run_blind_benchmark(
    settings: BlindBenchmark,
    *,
    workers: int = 1,
    cache: Path | None = None,
    methods: Registry[BlindMethod] | None = None,
    on_step: StepHook = ignore_step,
) -> BlindReport:
    """Run the benchmark; what the cache folder already holds is not computed again."""
    registry = compared if methods is None else methods
    chosen: dict[str, BlindMethod | None] = {UNTOUCHED: None}
    chosen |= {name: registry.create(name) for name in settings.methods}
    photos, kernels = list_photos(settings.photos), load_psfs()
    cases = [
        case
        for noise in settings.noise
        for case in make_cases(
            photos, len(kernels), half=settings.half, noise=noise, patch=settings.patch, seed=0,
            limit=settings.cases, scenes=settings.scenes,
        )
    ]  # fmt: skip
    contents = {photo: hashlib.sha256(photo.read_bytes()).hexdigest() for photo in photos}

    def key(case: BlindCase, name: str) -> str:
        return key_of(case, contents[case.photo], kernels[case.psf_number], name, chosen[name])

    file = None if cache is None else cache / "blind.jsonl"
    known = dict(_stored(file)) if file is not None and file.exists() else {}
    missing = {case: {n: m for n, m in chosen.items() if key(case, n) not in known} for case in cases}
    jobs = [(case, kernels[case.psf_number], methods) for case, methods in missing.items() if methods]
    for done, (case, results) in enumerate(_run(jobs, workers), start=len(cases) - len(jobs) + 1):
        fresh = {key(case, result.method): result for result in results}
        known |= fresh
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as out:
                out.writelines(json.dumps({"key": k, **plain(asdict(r))}) + "\n" for k, r in fresh.items())
        on_step(done, len(cases))
    return BlindReport(settings, tuple(known[key(case, name)] for case in cases for name in chosen))


Job = tuple[BlindCase, Kernel, Mapping[str, BlindMethod | None]]  # a case, and the methods without a result


def _run(jobs: Sequence[Job], workers: int) -> Iterator[tuple[BlindCase, list[CaseResult]]]:
    if workers <= 1:
        for job in jobs:
            yield job[0], _run_job(*job)
        return
    # Fresh processes: a fork would inherit locks of the numerical libraries' threads.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        pending = {pool.submit(_run_job, *job): job[0] for job in jobs}
        for future in as_completed(pending):
            yield pending[future], future.result()


def _run_job(case: BlindCase, true: Kernel, methods: Mapping[str, BlindMethod | None]) -> list[CaseResult]:
    seen, sigma = observe(case, true), case.noise
    reference = deconvolved(seen.patch, true, sigma, (0.0, 0.0))
    floor = max(squared_error(reference, seen.sharp), 1e-12)
    untouched = squared_error(seen.patch, seen.sharp) / floor
    results = []
    for name, method in methods.items():
        started = time.perf_counter()
        estimate = None
        if method is not None:
            try:
                estimate = method.estimate([seen.patch], [seen.noise], size=KERNEL_SIZE)
            except NotEnoughEvidenceError as error:
                logger.info("%s declined %s: %s", name, case.name, error)
        seconds = time.perf_counter() - started
        kernel = psf.delta(3) if estimate is None else np.asarray(estimate.kernel)
        found, ratio = kernels.distance(kernel, true), untouched
        if estimate is not None:
            restored = deconvolved(seen.patch, kernel, sigma, found.shift)
            ratio = squared_error(restored, seen.sharp) / floor
        widths = psf.rms_width(kernel), psf.rms_width(true)
        declined = method is not None and estimate is None
        distances = (found.ncc, found.rel_l2, found.mtf_rmse)
        results.append(
            CaseResult(case.name, name, sigma, ratio, untouched, *distances, *widths, declined, seconds)
        )
    return results


_HEADS = (
    *("noise", "method", "cases", "better than blurry", "ER < 3", "ER < 2", "ER median (p90)"),
    *("NCC", "rel. L2", "MTF error", "width", "seconds"),
)


def markdown_table(report: BlindReport) -> str:
    """Return the summary as a Markdown table, shares in percent."""
    rows = [
        [
            *(f"{100 * s['noise']:g} %", s["method"], str(s["cases"])),
            "" if s["method"] == UNTOUCHED else f"{100 * s['improved']:.0f} %",
            *(f"{100 * s[name]:.0f} %" for name in ("er_lt_3", "er_lt_2")),
            f"{s['er_median']:.2f} ({s['er_p90']:.1f})",
            *(f"{s['ncc']:.3f}", f"{s['rel_l2']:.2f}", f"{s['mtf_rmse']:.3f}"),
            *(f"{s[name]:.2f}" for name in ("width_ratio", "seconds")),
        ]
        for s in summarised(report.results)
    ]
    return table(_HEADS, rows) + "\n"


def curve_figure(report: BlindReport, noise: float) -> Figure:
    """Draw the percent of cases with an error ratio below t, for t in 1..10: 1 is the true kernel."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.add_subplot()
    for method in dict.fromkeys(r.method for r in report.results if r.noise == noise):
        ratios = [r.error_ratio for r in report.results if r.method == method and r.noise == noise]
        untouched = method == UNTOUCHED
        line = ax.ecdf(ratios, label="no correction" if untouched else method)
        if untouched:
            line.set(color="grey", linestyle="--")
    ax.set(xlabel="error ratio t", ylabel="cases", xlim=(1.0, 10.0), ylim=(0.0, 1.0))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.set_title(f"Cases with an error ratio below t, {100 * noise:g} % noise", loc="left", fontsize=10)
    ax.grid(color="#e5e5e0")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


FILES: Final = ("blind.json", "blind.md")  # what a finished report consists of, beside its curves


def write_report(report: BlindReport, folder: Path) -> tuple[Path, ...]:
    """Write `FILES`, and one curve a noise level as SVG and PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / name for name in FILES]
    texts = (report.to_json(), markdown_table(report))
    for path, text in zip(written, texts, strict=True):
        path.write_text(text, encoding="utf-8")
    for noise in report.settings.noise:
        for ending in ("svg", "png"):
            written.append(folder / f"blind-er-{100 * noise:g}percent.{ending}")
            curve_figure(report, noise).savefig(written[-1], dpi=160)
    return tuple(written)
