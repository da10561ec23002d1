"""One local wavefront fitted to the spectra of all patches of a position, and to a kernel estimated before.

Power says how wide the blur is in every direction, the better the more patches share it, and nothing of
its phase; a kernel estimated otherwise, the reference, knows the phase, but its width is biased. The eight
terms of the wavefront have to suit both, so they minimise::

    temper * sum t(residuals of log power)  -  parts * ln L(local spectra)
        +  weight |k(g) - k_ref|² / |k_ref|²  +  |g / usual|²

by Levenberg-Marquardt from random wavefronts about as wide as the reference. t is the log-likelihood of
Student's t: scenes have stripes that no polynomial follows. L is that of `local_spectra`, where such spectra
are given; its curvature in the normal equations is Fisher's information with the components of the tiles
known. For the true wavefront the likelihood is best where the scene's prior holds
(`tests/lensmodel/estimation/test_local_wavefront.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.descent import Descent
from lensmodel.core.psf import as_kernel, centred, resized, rms_width
from lensmodel.core.types import Kernel, StepHook, ignore_step
from lensmodel.estimation.spectra.local_spectra import LocalSpectra, log_local_power
from lensmodel.estimation.spectra.scene_spectra import SceneSpectra, log_power
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.local_pupil import COMA, Pupil
from lensmodel.optics.pupil import TERMS
from lensmodel.scene.prior import TAILS

_STRIDE_PX = 1.0  # pixels of blur: no term changes by more in one step (chosen)
_ENOUGH = 0.05  # of the cost: less gained in a step ends the fit (chosen)
_TRIES = 4  # steps with more damping before the fit ends: after four they are too short to gain (chosen)
_SIDES: Final = (31, 47)  # pixels of the kernel: for usual and for wide blur (chosen)
_WIDE_PX = 2.8
"""RMS width from which on the larger one is taken: five of them fit into half of the smaller side
(chosen)."""

_SEED = 0  # any number: fits repeat to the bit

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AberrationFit:
    """How to weigh spectra against the reference kernel, and how long to search.

    Parameters
    ----------
    weight : float
        Of the reference kernel (chosen: it has to decide the phase, not the width).
    temper : float
        Share of the spectra's likelihood that counts (chosen): neighbouring bins err alike.
    starts : int
        Random wavefronts, each moved `approach` steps towards the reference alone and `first` steps with
        the spectra.
    kept, rounds : int
        So many of the best go on for at most `rounds` steps; only these see local spectra.
    parts : float
        Share of the likelihood of local spectra that counts (chosen): tiles overlap.
    size : int
        Odd side of the kernels that are asked for; where it is the largest of all, it is fitted on.
    """

    weight: float = 20.0
    temper: float = 0.25
    starts: int = 24
    approach: int = 2
    first: int = 4
    kept: int = 8
    rounds: int = 12
    parts: float = 0.02
    size: int = 31

    def fit(
        self,
        spectra: SceneSpectra,
        reference: Kernel,
        on_step: StepHook = ignore_step,
        local: LocalSpectra | None = None,
    ) -> LocalWavefront:
        """Fit.

        Parameters
        ----------
        spectra : SceneSpectra
        reference : Kernel
            Centred.
        on_step : StepHook
            Progress; raising `CancelledError` there stops the work.
        local : LocalSpectra, optional
            Spectra of small tiles of the same patches.
        """
        width = max(rms_width(reference), 0.3)
        usual, wide = _SIDES
        pupil = Pupil.of(self.size if self.size > wide else wide if width > _WIDE_PX else usual)
        target = resized(reference, pupil.size)
        rng = np.random.default_rng(_SEED)
        shape, total = ABERRATIONS.drawn_at_place, self.starts + self.kept + 1
        fits = []
        for done in range(self.starts):
            start = np.zeros(TERMS)
            start[: len(shape)] = rng.standard_normal(len(shape)) * shape * width
            approached = self._descend(pupil, target, start, _Evidence(None), self.approach)
            fits.append(self._descend(pupil, target, approached.terms, _Evidence(spectra), self.first))
            on_step(done + 1, total)
        evidence = _Evidence(spectra, local)
        refined = []
        for done, fit in enumerate(sorted(fits, key=_cost)[: self.kept]):
            refined.append(self._descend(pupil, target, fit.terms, evidence, self.rounds))
            on_step(self.starts + done + 1, total)
        best = min(refined, key=_cost)
        # The spectra of a kernel and of its turned copy are equal: only the reference tells them apart.
        turned = best.terms.copy()
        turned[[*COMA, -2, -1]] *= -1.0
        best = min(best, self._descend(pupil, target, turned, evidence, self.rounds // 2), key=_cost)
        on_step(total, total)
        return best

    def _descend(
        self, pupil: Pupil, target: Kernel, terms: Floats, evidence: _Evidence, rounds: int
    ) -> LocalWavefront:
        def moved(state: _PatchFit, step: Floats) -> _PatchFit:
            step = step * min(1.0, _STRIDE_PX / max(float(np.abs(step[:TERMS]).max()), 1e-9))
            after, levels = state.terms + step[:TERMS], state.levels + step[TERMS:]
            return self._state(pupil, target, after, evidence, levels)

        begin = self._state(pupil, target, terms, evidence, None)
        state = Descent(rounds, _TRIES, enough=_ENOUGH).down(begin, moved)
        return LocalWavefront(state.terms, state.kernel, state.cost)

    def _state(
        self, pupil: Pupil, target: Kernel, terms: Floats, evidence: _Evidence, levels: Floats | None
    ) -> _PatchFit:
        kernel, changes = pupil.kernel(terms)
        off, flat = (kernel - target).ravel(), changes.reshape(TERMS, -1)
        weight = self.weight / float((target**2).sum())
        spread = ABERRATIONS.at_place
        usual = terms / spread
        state = _PatchFit(
            terms,
            np.zeros(0),
            kernel,
            float(usual @ usual) + weight * float(off @ off),
            np.diag(1.0 / spread**2) + weight * (flat @ flat.T),
            -usual / spread - weight * (flat @ off),
        )
        if evidence.whole is not None:
            count = len(evidence.whole.log_power)
            state = self._with_whole(
                state, changes, evidence.whole, None if levels is None else levels[:count]
            )
            if evidence.local is not None:
                state = self._with_local(
                    state, changes, evidence.local, None if levels is None else levels[count:]
                )
        return state

    def _with_whole(
        self, state: _PatchFit, changes: Floats, spectra: SceneSpectra, amplitudes: Floats | None
    ) -> _PatchFit:
        """Add what whole spectra say; the amplitudes of the scenes become unknowns."""
        blur, by_terms = log_power(state.kernel, changes)
        if amplitudes is None:
            amplitudes = spectra.begin(blur)
        left, change = spectra.residuals(blur, by_terms, amplitudes)
        weighted = change * (self.temper * (TAILS + 1.0) / (TAILS + left**2))[:, None]
        normal, gradient = change.T @ weighted, -(weighted.T @ left)
        normal[:TERMS, :TERMS] += state.normal
        gradient[:TERMS] += state.gradient
        cost = state.cost + self.temper * (TAILS + 1.0) * float(np.log1p(left**2 / TAILS).sum())
        return _PatchFit(state.terms, amplitudes, state.kernel, cost, normal, gradient)

    def _with_local(
        self, state: _PatchFit, changes: Floats, local: LocalSpectra, gains: Floats | None
    ) -> _PatchFit:
        """Add what local spectra say; the gains of the patches become unknowns."""
        power, by_terms = log_local_power(state.kernel, changes)
        if gains is None:
            gains = local.gains(power)
        known, cost = len(state.gradient), state.cost
        every = known + len(gains)
        normal, gradient = np.zeros((every, every)), np.zeros(every)
        normal[:known, :known], gradient[:known] = state.normal, state.gradient
        moved = np.column_stack([by_terms, np.ones(len(power))])
        for i, gain in enumerate(gains):
            value, slope, curvature = local.pull(i, power + gain)
            at = np.append(np.arange(TERMS), known + i)
            cost -= self.parts * value
            normal[np.ix_(at, at)] += self.parts * (moved.T * curvature) @ moved
            gradient[at] += self.parts * (moved.T @ slope)
        levels = np.concatenate([state.levels, gains])
        return _PatchFit(state.terms, levels, state.kernel, cost, normal, gradient)


@dataclass(frozen=True, slots=True, eq=False)
class LocalWavefront:
    """A wavefront, pixels of blur by term, with its kernel where the pupil puts it, and its cost."""

    terms: Floats
    light: Floats
    cost: float

    @property
    def unusual(self) -> float:
        """How unusual the wavefront is before any data, |g / usual|²."""
        return float(np.square(self.terms / ABERRATIONS.at_place).sum())

    def kernel(self, size: int) -> Kernel:
        """Kernel of odd side `size`, centred."""
        return resized(centred(as_kernel(self.light)), size)


def _cost(fit: LocalWavefront) -> float:
    return fit.cost


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Spectra that a descent fits; without any it fits the reference alone."""

    whole: SceneSpectra | None
    local: LocalSpectra | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _PatchFit:
    """Where a descent is: the terms, the amplitudes and gains of the patches, and which way down."""

    terms: Floats
    levels: Floats
    kernel: Floats
    cost: float
    normal: Floats
    gradient: Floats
