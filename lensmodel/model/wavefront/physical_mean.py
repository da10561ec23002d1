"""The physical mean of a lens and what its samples say beyond it.

One wavefront N is fitted to all samples C (`wavefront_fit`) and rendered where a question is asked:
kernels of the corner change too quickly over the field to be interpolated between nodes. What is left
of the samples is kriged with mean zero, so that far from all samples the wavefront alone remains::

    f(x, y) = N(x, y) + c'(x, y) K^-1 (C - N),    K = c + nugget / q

Where the samples carry the spectra of their patches, the wavefront is fitted to those instead
(`from_spectra`) and stands alone: all patches agree on it, while finished kernels carry each patch's own
mistake. That is so unless the patches are clearly likelier behind the kernels of their neighbours.

Cost: some seconds of CPU for the fit, one or two milliseconds at each question.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.psf import PsfSample, as_kernel, resized
from lensmodel.core.types import FieldPosition, Kernel, LensSettings, StepHook, ignore_step
from lensmodel.model import variables as va
from lensmodel.model.field.kriging import NUGGETS, field_vector, matern, settings_gap, squared_gaps
from lensmodel.model.wavefront.from_kernels import (
    MIN_SAMPLES,
    ONE_FOCAL_LENGTH,
    fit_wavefront,
    focal_range,
    spread_samples,
)
from lensmodel.model.wavefront.joint_kernels import Pooled, pool_samples
from lensmodel.model.wavefront.likelihood import surprise
from lensmodel.optics.wavefront import Wavefront

_MOST = 240  # samples of the remainder's process: its cost grows with their cube (chosen)
_USUAL_SIDE = 31  # pixels: larger kernels are estimated where blur is known to reach far (chosen)
_AROUND = 6
"""Pixels beyond the side that was fitted, for corners wider than every sample: more is rendered for nothing
(chosen)."""
_NOTHING_LEFT = 1e3  # a nugget so large that the wavefront answers alone (chosen: rests count a thousandth)
_WORST = 1.5  # relative errors beyond count no more than this: one outlier chooses nothing (chosen)
_ALIKE = 1e-7  # covariance below which a sample is left out of an answer: below single precision (chosen)
_CLEARLY = 2.0  # standard errors: more happens by chance in one lens of forty (chosen)
_STEPS = 2  # of the progress: the fit, the remainder

NO_AGREEMENT: Final = "no agreement"
FEW_SPECTRA: Final = "few spectra"
SEVERAL_FOCAL_LENGTHS: Final = "several focal lengths"
REASONS_APART: Final = ("", NO_AGREEMENT, FEW_SPECTRA, SEVERAL_FOCAL_LENGTHS)
"""Why patches were not solved together, if they were not."""


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """A fitted wavefront with the kriged rest of the samples.

    Parameters
    ----------
    front : Wavefront
    side : int
        Odd side of the kernels.
    vectors, where : ndarray, shape (m, 2), (m, 7)
        Places and points of the samples that the rest is known of.
    scale : ndarray, shape (7,)
        Bandwidths, of which those of the settings count.
    rest : ndarray, shape (m, side^2)
        K^-1 (C - N): the rest at a place is the product of its covariances and this.
    errors : ndarray, shape (n,)
        Relative L2 of every sample, of its own group's rest nothing known; expected errors of the
        wavefront if `agreed`.
    agreed : bool
        Whether the wavefront was fitted to the spectra of all patches, and nothing is left to krige.
    diffraction_known : bool
        Whether aperture and pixel pitch of an agreed wavefront are known.
    turned : float
        Probability that an agreed wavefront gives all kernels turned by 180 degrees.
    why_apart : str
        Of `REASONS_APART`: why it is not `agreed`; empty if it is.
    """

    front: Wavefront
    side: int
    vectors: NDArray[np.float64]
    where: NDArray[np.float64]
    scale: NDArray[np.float64]
    rest: NDArray[np.float64]
    errors: NDArray[np.float64]
    agreed: bool = False
    diffraction_known: bool = False
    turned: float = 0.0
    why_apart: str = ""

    @classmethod
    def fit(
        cls,
        samples: Sequence[PsfSample],
        votes: NDArray[np.float64],
        groups: NDArray[np.intp],
        scale: NDArray[np.float64],
        on_step: StepHook = ignore_step,
        former: Sequence[Wavefront] = (),
    ) -> Physics | None:
        """Fit to samples; None where there are too few of them.

        Parameters
        ----------
        samples : sequence of PsfSample
        votes : ndarray, shape (n,)
            Those of 0 take no part.
        groups : ndarray of int, shape (n,)
            Samples that are held out together.
        scale : ndarray, shape (7,)
            Bandwidths.
        former : sequence of Wavefront
            What earlier fits of the lens, to fewer samples, came to.
        """
        voting = [int(i) for i in np.flatnonzero(votes > 0)]
        if len(voting) < MIN_SAMPLES:
            return None
        on_step(0, _STEPS)
        trusted = [samples[i].with_weight(float(votes[i])) for i in voting]
        # spectra of one focal length alone are solved together
        several = focal_range(trusted) > ONE_FOCAL_LENGTH
        pooled = None if several else pool_samples(trusted, on_step, former)
        if pooled is not None and _suits(pooled, trusted):
            side = max(s.kernel.shape[0] for s in samples)
            empty = np.empty((0, 2)), np.empty((0, len(scale))), scale, np.empty((0, side**2))
            # spectra tell of wings that kernels estimated one by one have not
            whole = pooled.front if side <= _USUAL_SIDE else replace(pooled.front, size=side)
            return cls(
                *(whole, side, *empty, pooled.errors(samples)),
                agreed=True,
                diffraction_known=pooled.diffraction_known,
                turned=pooled.turned,
            )
        known = {id(samples[i]): i for i in voting}
        front = fit_wavefront(trusted)
        if front is None:
            return None
        on_step(1, _STEPS)
        kept = sorted(known[id(s)] for s in spread_samples([samples[i] for i in voting], _MOST))
        chosen = np.array(kept, dtype=np.intp)
        nodes = [samples[i] for i in kept]
        side = max(s.kernel.shape[0] for s in samples)
        wanted = np.stack([resized(s.kernel, side).ravel() for s in nodes])
        left = wanted - [_rendered(front, side, s.position, s.settings) for s in nodes]
        where = va.points(nodes)
        vectors = va.vectors(where)
        gaps = settings_gap(where[:, None, :], where[None, :, :], scale)
        covariance = matern(np.sqrt(squared_gaps(vectors, vectors))) * np.exp(-0.5 * gaps)
        rest, held = _kriged(covariance, np.maximum(votes[chosen], 1e-3), groups[chosen], left)
        seen = held / np.maximum(np.sqrt((wanted**2).sum(axis=1)), 1e-30)
        errors = np.full(len(samples), float(np.median(seen)))
        errors[chosen] = seen
        on_step(_STEPS, _STEPS)
        apart = SEVERAL_FOCAL_LENGTHS if several else FEW_SPECTRA if pooled is None else NO_AGREEMENT
        return cls(front, side, vectors, where, scale, rest, errors, why_apart=apart)

    def rows(self, positions: Sequence[FieldPosition], settings: LensSettings) -> NDArray[np.float64]:
        """Kernels of the image frame as flat rows, shape (q, side^2)."""
        rendered = np.stack([_rendered(self.front, self.side, place, settings) for place in positions])
        if self.agreed:
            return rendered
        alike = np.exp(-0.5 * settings_gap(self.where, va.point(positions[0], settings), self.scale))
        near = np.flatnonzero(alike > _ALIKE)
        if near.size:
            vectors = np.array([field_vector(position) for position in positions])
            towards = matern(np.sqrt(squared_gaps(vectors, self.vectors[near]))) * alike[near]
            rendered += towards @ self.rest[near]
        return rendered

    def extended_errors(self, count: int) -> NDArray[np.float64]:
        """Held-out errors of the first `count` samples; the usual one of those added later."""
        usual = np.full(max(count - len(self.errors), 0), float(np.median(self.errors)))
        return np.concatenate([self.errors[:count], usual])


def _suits(pooled: Pooled, samples: Sequence[PsfSample]) -> bool:
    """Whether patches are not clearly less likely behind the wavefront than behind their neighbours' kernels.

    A blur that no wavefront of a few numbers makes, of a plain Gaussian for example, leaves them less likely,
    one patch as the other. The kernel that a patch gave itself follows its own scene too: it is no judge.
    """
    seen = [s for s in samples if s.spectrum is not None and s.settings.channel == "g"]
    seen = seen or [s for s in samples if s.spectrum is not None]
    worse = [
        surprise(s, pooled.kernel(s, s.kernel.shape[0])) - surprise(s, _neighbour(s, seen)) for s in seen
    ]
    return float(np.mean(worse)) < _CLEARLY * float(np.std(worse)) / math.sqrt(len(worse))


def _neighbour(sample: PsfSample, others: Sequence[PsfSample]) -> Kernel:
    """Kernel of the nearest patch that was estimated apart from this one, turned to its place."""
    apart = [other for other in others if not np.array_equal(other.kernel, sample.kernel)]
    if not apart:
        return sample.kernel
    here = field_vector(sample.position)
    nearest = min(apart, key=lambda other: float(((field_vector(other.position) - here) ** 2).sum()))
    angle = math.degrees(sample.position.phi - nearest.position.phi)
    turned = ndimage.rotate(nearest.kernel, angle, reshape=False, order=3)
    return as_kernel(np.maximum(turned, 0.0))


def _rendered(
    front: Wavefront, side: int, position: FieldPosition, settings: LensSettings
) -> NDArray[np.float64]:
    kernel = front.kernel(position, settings, min(front.size + _AROUND, side))
    return resized(kernel, side).ravel()


def _kriged(
    covariance: NDArray[np.float64],
    votes: NDArray[np.float64],
    groups: NDArray[np.intp],
    left: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K^-1 R and the norms of R - R predicted from other groups, for the best nugget.

    The residuals of a group p that was left out are ((K^-1)_pp)^-1 (K^-1 R)_p.
    """
    best: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
    for nugget in (*NUGGETS, _NOTHING_LEFT):
        inverse = np.linalg.inv(covariance + np.diag(nugget / votes))
        answered = inverse @ left
        held = np.empty(len(left))
        for group in np.unique(groups):
            own = np.flatnonzero(groups == group)
            missed = np.linalg.solve(inverse[np.ix_(own, own)], answered[own])
            held[own] = np.sqrt((missed**2).sum(axis=1))
        score = float(votes @ np.minimum(held, _WORST))
        if best is None or score < best[0]:
            best = score, answered, held
    assert best is not None
    return best[1], best[2]
