"""What the blind benchmark is asked and what it answers: settings, cases, one row a method."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from lab.cases import CHOICES, HALVES, VARIANTS, Choice, Half, Variant
from lensmodel.core.errors import InvalidInputError

PROTOCOL = 2
"""Part of every cache key; raised when cases or metrics change."""

UNTOUCHED = "none"
"""The method that does nothing: the baseline of every table."""


@dataclass(frozen=True, slots=True)
class BlindBenchmark:
    """What to run.

    Parameters
    ----------
    photos : Path or None
        Folder of sharp photographs; None means those of the library.
    psfs : Path or None
        .npz file with `psf` (n, k, k); None means the library's twelve.
    noise : tuple of float
        Standard deviations as shares of full range.
    methods : tuple of str
        Names of blind estimators; "none" is always added.
    half : {"dev", "test", "all"}
        Which half of photos and PSFs.
    cases : int or None
        At most so many, spread over photos and PSFs.
    patch, kernel_size : int
        Sides in pixels; the kernel's is odd.
    pool : int
        Patches of different photos that share one kernel.
    variant : {"gaussian", "bayer", "jpeg"}
        The camera.
    judge : str
        Non-blind deconvolution: "hyper-laplacian" or "epll".
    seed : int
        For windows, noise and the choice of cases.
    selection : {"random", "r-map", "good-regions"}
        Who chooses the windows: chance among the better half, or a selector on the blurred photograph.
    scenes : int or None
        So many windows of the photographs in turn; None means one of each.
    """

    photos: Path | None = None
    psfs: Path | None = None
    noise: tuple[float, ...] = (0.01,)
    methods: tuple[str, ...] = ("default",)
    half: Half = "test"
    cases: int | None = None
    patch: int = 256
    kernel_size: int = 31
    pool: int = 1
    variant: Variant = "gaussian"
    judge: str = "hyper-laplacian"
    seed: int = 0
    selection: Choice = "random"
    scenes: int | None = None

    def __post_init__(self) -> None:
        checks = {
            f"half must be one of {', '.join(HALVES)}, got {self.half!r}": self.half in HALVES,
            f"variant must be one of {', '.join(VARIANTS)}, got {self.variant!r}": self.variant in VARIANTS,
            f"selection must be one of {', '.join(CHOICES)}, got {self.selection!r}": (
                self.selection in CHOICES
            ),
            f"patch must be a multiple of 4 of at least 128, got {self.patch}": self.patch >= 128
            and self.patch % 4 == 0,
            f"kernel size must be odd and at least 5, got {self.kernel_size}": self.kernel_size >= 5
            and self.kernel_size % 2 == 1,
            f"pool must be at least 1, got {self.pool}": self.pool >= 1,
            f"noise must lie in 0.0001..0.2, got {self.noise}": all(1e-4 <= s <= 0.2 for s in self.noise),
        }
        for text, holds in checks.items():
            if not holds:
                raise InvalidInputError(text)


@dataclass(frozen=True, slots=True)
class CaseResult:
    """One method on one case.

    Parameters
    ----------
    case, method : str
    noise : float
    error_ratio, untouched_ratio : float
        ER with the estimated kernel, and of the blurred patch as it is.
    ncc, rel_l2, mtf_rmse : float
        Against the true kernel after sub-pixel alignment; see `psf.distance`.
    width_px, true_width_px : float
        RMS widths.
    confidence, predicted_error : float
        What the estimator says of itself; NaN for "none".
    declined : bool
        The estimator gave no answer; the patch then stays as it is.
    seconds : float
        Of the estimate alone.
    """

    case: str
    method: str
    noise: float
    error_ratio: float
    untouched_ratio: float
    ncc: float
    rel_l2: float
    mtf_rmse: float
    width_px: float
    true_width_px: float
    confidence: float
    predicted_error: float
    declined: bool
    seconds: float

    @property
    def improved(self) -> bool:
        """Whether deblurring with the estimate beats doing nothing."""
        return self.error_ratio < self.untouched_ratio


@dataclass(frozen=True, slots=True)
class MethodSummary:
    """One method at one noise level; shares are of all cases, the rest are medians.

    `moment_bias` is the median of the difference of mean second moments, estimated minus true, in
    px²; `width_ratio` the median of RMS width over the true one, NaN for points; `er_p90` a percentile.
    """

    method: str
    noise: float
    cases: int
    improved: float
    er_lt_3: float
    er_lt_2: float
    er_median: float
    er_p90: float
    ncc: float
    rel_l2: float
    mtf_rmse: float
    moment_bias: float
    width_ratio: float
    declined: int
    seconds: float


@dataclass(frozen=True, slots=True)
class BlindReport:
    """Outcome of a run: the settings, one row a method and noise level, and every case."""

    settings: BlindBenchmark
    summary: tuple[MethodSummary, ...]
    results: tuple[CaseResult, ...]

    def to_json(self) -> dict[str, object]:
        """Return settings, summary and cases as plain values; NaN becomes None."""
        settings = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self.settings).items()}
        return {
            "benchmark": "blind",
            "protocol": PROTOCOL,
            "settings": settings,
            "summary": [plain(asdict(row)) for row in self.summary],
            "cases": [{**plain(asdict(row)), "improved": row.improved} for row in self.results],
        }


def summarised(results: Sequence[CaseResult]) -> tuple[MethodSummary, ...]:
    """One row a method and noise level, in the order of first appearance."""
    groups: dict[tuple[float, str], list[CaseResult]] = {}
    for result in results:
        groups.setdefault((result.noise, result.method), []).append(result)
    return tuple(_summary(noise, method, rows) for (noise, method), rows in groups.items())


def _summary(noise: float, method: str, rows: Sequence[CaseResult]) -> MethodSummary:
    def median(of: Callable[[CaseResult], float]) -> float:
        return float(np.median([of(row) for row in rows]))

    ratios = np.array([row.error_ratio for row in rows])
    return MethodSummary(
        method=method,
        noise=noise,
        cases=len(rows),
        improved=float(np.mean([row.improved for row in rows])),
        er_lt_3=float((ratios < 3.0).mean()),
        er_lt_2=float((ratios < 2.0).mean()),
        er_median=float(np.median(ratios)),
        er_p90=float(np.percentile(ratios, 90.0)),
        ncc=median(lambda row: row.ncc),
        rel_l2=median(lambda row: row.rel_l2),
        mtf_rmse=median(lambda row: row.mtf_rmse),
        moment_bias=median(lambda row: row.width_px**2 - row.true_width_px**2),
        width_ratio=median(lambda row: row.width_px / row.true_width_px if row.true_width_px else math.nan),
        declined=sum(row.declined for row in rows),
        seconds=median(lambda row: row.seconds),
    )


def plain(row: Mapping[str, object]) -> dict[str, object]:
    """Return a row with None for what is no finite number, as JSON wants it."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
