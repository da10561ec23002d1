"""The normal equations of all patches, summed with the weights of a question and solved once.

Finished kernels can only be averaged; what one patch leaves open, another may decide. So each patch keeps
the autocorrelation R of its latent scene and the cross-correlation r with what was seen (`evidence`). A
kernel f of the asked place is seen by sample i through the map M of pixel offsets (`local_frame`)::

    S_i(p) = f(M^-1 p) / |M|
    S_i' R_i S_i - 2 r_i' S_i = sum_ab f(a) f(b) R_i(M (a - b)) - 2 sum_a f(a) r_i(M a)

so that statistics turn and scale as kernels do, and with W_i the weights of a question (eq. 7 of the paper)
and s_i the noise of a patch, one kernel step solves

    min over f >= 0 of   sum_i W_i / s_i^2 (f' R_i f - 2 r_i' f) + ridge.

R and r are taken of gradients (minus their Laplacians): of intensities R is nearly flat, and the small
differences that tell a kernel drown in what turning it costs. Gradients are noisier, though: the more noise
a patch has, the more of the intensities is added. Each patch knows its kernel up to a shift: r is moved so
that it fits the patch's own, centred kernel best. Offsets beyond a patch's own support say nothing; samples
with a smaller support than is usual near a place are left out there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.evidence import PatchEvidence, solve_kernel
from lensmodel.core.psf import PatchStatistics, PsfSample, resized
from lensmodel.core.spectrum import RINGS, SECTORS
from lensmodel.core.types import Kernel
from lensmodel.model.field import splines
from lensmodel.model.field.kernel_store import KernelStore
from lensmodel.model.field.local_frame import MIRRORED, Answers, LocalKernels, affine_maps

_LEAST_NOISE = 1e-4
_NONE = -1
_LEAST_SHARE = 0.05
_LEAST_SIDE = 3
_RIM = 2
_WHOLE = 5.0  # share of the intensities themselves, for a noise of the patch's whole range


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Statistics of the samples that have them; extended, never changed.

    Parameters
    ----------
    side : int
        Odd side of the largest support.
    correlations, crosses : KernelStore
        Spline coefficients of R (2 side - 1)^2 and r side^2, divided by the variance of the noise, and of
        two more on either side.
    rows : ndarray of int, shape (n,)
        Where each sample's lie; -1 for those without.
    supports : ndarray of int, shape (n,)
        Side of each sample's own support; 0 for those without.
    """

    side: int
    correlations: KernelStore
    crosses: KernelStore
    rows: NDArray[np.intp]
    supports: NDArray[np.intp]

    @classmethod
    def of(cls, samples: Sequence[PsfSample]) -> NormalEquations | None:
        """Keep the statistics of samples; None where none has any."""
        side = max((_support(s.evidence) for s in samples if s.evidence is not None), default=0)
        if side < _LEAST_SIDE:
            return None
        none = np.empty(0, dtype=np.intp)
        start = cls(
            side, KernelStore((2 * side - 1 + 2 * _RIM) ** 2), KernelStore((side + 2 * _RIM) ** 2), none, none
        )
        return start.extended(samples)

    def extended(self, samples: Sequence[PsfSample]) -> NormalEquations:
        """Return these with more; supports larger than `side` are cut."""
        with_statistics = [(s, s.evidence) for s in samples if s.evidence is not None]
        known = np.array([s.evidence is not None for s in samples], dtype=bool)
        count = len(with_statistics)
        rows = np.full(len(samples), _NONE, dtype=np.intp)
        rows[known] = len(self.correlations.rows) + np.arange(count)
        supports = np.zeros(len(samples), dtype=np.intp)
        supports[known] = [min(_support(e), self.side) for _, e in with_statistics]

        def correlations() -> Iterator[NDArray[np.float32]]:
            for _, e in with_statistics:
                sharp = _sharpened(e.autocorrelation, e.noise)[1:-1, 1:-1]
                yield _coefficients(sharp / _variance(e), 2 * self.side - 1)

        def crosses() -> Iterator[NDArray[np.float32]]:
            for sample, e in with_statistics:
                yield _coefficients(_aligned(e, sample.kernel) / _variance(e), self.side)

        return replace(
            self,
            correlations=self.correlations.extended(correlations(), count),
            crosses=self.crosses.extended(crosses(), count),
            rows=np.concatenate([self.rows, rows]),
            supports=np.concatenate([self.supports, supports]),
        )

    def kernel(
        self,
        local: LocalKernels,
        answers: Answers,
        question: int,
        angle: float,
        widths: NDArray[np.float64],
        size: int,
        mirror: float = 0.0,
    ) -> Kernel | None:
        """Kernel of one question; None where its neighbours have next to no statistics.

        Parameters
        ----------
        local : LocalKernels
            Frames of the samples.
        answers : Answers
            Weights of the samples.
        question : int
            Which of the answers.
        angle : float
            phi of the place.
        widths : ndarray, shape (2,)
            Scales of the place.
        size : int
            Odd side of the result.
        mirror : float
            Weight of mirror images.
        """
        part = slice(answers.starts[question], answers.starts[question + 1])
        chosen, weights = answers.rows[part], np.maximum(answers.weights[part], 0.0)
        support = self.supports[chosen]
        known = support > 0
        if weights[known].sum() < _LEAST_SHARE * weights.sum():
            return None
        side = _weighted_median(support[known], weights[known])
        kept = np.flatnonzero(support >= side)
        chosen, votes = chosen[kept], weights[kept]
        scale = local.widths[chosen] / widths
        here = np.full(kept.size, angle)
        maps = affine_maps(local.angles[chosen], here, scale)
        if mirror > 0.0:
            flipped = affine_maps(local.angles[chosen], here, scale * MIRRORED)
            maps, chosen = np.concatenate([maps, flipped]), np.concatenate([chosen, chosen])
            votes = np.concatenate([votes, mirror * votes])
        stored = self.rows[chosen]

        def summed(store: KernelStore, across: int) -> NDArray[np.float32]:
            everywhere = np.full(len(store.rows), 2.0 * self.side)
            starts, still = np.array([0, stored.size], dtype=np.intp), np.zeros((1, 2))
            found = splines.sums(
                store.rows, everywhere, stored, votes, maps, starts, still, across, engine=local.engine
            )
            return np.asarray(found[0], dtype=np.float32)

        statistics = PatchEvidence(
            autocorrelation=summed(self.correlations, 2 * side - 1),
            crosscorrelation=summed(self.crosses, side),
            pixels=1,
            noise=1.0,
            spectrum=np.zeros((RINGS, SECTORS), dtype=np.float32),
            spectrum_noise=0.0,
        )
        return solve_kernel([statistics], [1.0], size)


def _support(statistics: PatchStatistics) -> int:
    """Odd side of the kernels that the statistics of gradients determine."""
    return statistics.crosscorrelation.shape[0] - 2


def _sharpened(values: NDArray[np.floating], noise: float) -> NDArray[np.float64]:
    """Minus the Laplacian, where all neighbours are known, and some of the values as they are."""
    whole = min(_WHOLE * noise, 1.0)
    inner = np.asarray(values, dtype=np.float64)
    around = inner[:-2, 1:-1] + inner[2:, 1:-1] + inner[1:-1, :-2] + inner[1:-1, 2:]
    return np.asarray((4.0 + whole) * inner[1:-1, 1:-1] - around)


def _variance(statistics: PatchStatistics) -> float:
    return max(statistics.noise, _LEAST_NOISE) ** 2


def _weighted_median(values: NDArray[np.intp], weights: NDArray[np.float64]) -> int:
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return int(values[order[np.searchsorted(below, 0.5 * below[-1])]])


def _coefficients(values: NDArray[np.floating], side: int) -> NDArray[np.float32]:
    """Coefficients of the cubic spline through values, in the middle of a square of odd side."""
    own = values.shape[0]
    cut, pad = max((own - side) // 2, 0), max((side - own) // 2, 0)
    # the values at the rim need coefficients beyond it
    wider = np.pad(values[cut : own - cut, cut : own - cut], _RIM, mode="reflect")
    spline = ndimage.spline_filter(wider, order=3, mode="mirror")
    return np.asarray(np.pad(spline, pad), dtype=np.float32).ravel()


def _aligned(statistics: PatchStatistics, kernel: Kernel) -> NDArray[np.float64]:
    """Sharpened r, moved so that r'k is largest for the patch's own kernel k."""
    cross = _sharpened(statistics.crosscorrelation, statistics.noise)
    side = cross.shape[0]
    own = resized(kernel, side)
    period = 2 * side - 1
    found = fft.irfft2(
        fft.rfft2(cross, (period, period)) * np.conj(fft.rfft2(own, (period, period))), (period, period)
    )
    found = fft.fftshift(found)
    row, col = (int(i) for i in np.unravel_index(int(found.argmax()), found.shape))
    row, col = min(max(row, 1), period - 2), min(max(col, 1), period - 2)
    by_row = _vertex(found[row - 1 : row + 2, col])
    by_col = _vertex(found[row, col - 1 : col + 2])
    away = (period // 2 - row - by_row, period // 2 - col - by_col)
    return np.asarray(ndimage.shift(cross, away, order=3, mode="nearest"))


def _vertex(three: NDArray[np.float64]) -> float:
    """Where the parabola through three equidistant values has its maximum, from the middle one."""
    curve = three[0] - 2.0 * three[1] + three[2]
    return 0.0 if curve >= 0.0 else float(np.clip(0.5 * (three[0] - three[2]) / curve, -1.0, 1.0))
