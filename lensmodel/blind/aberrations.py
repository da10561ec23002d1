"""One local wavefront fitted to the spectra of all patches of a position, and to a kernel found before.

Power says how wide the blur is in every direction, the better the more patches share it, and nothing of
its phase; a kernel found by other means knows the phase and has a width of its own bias. The eight
numbers of a wavefront have to please both, so that this is least::

    temper * sum t(residuals of log power)  +  weight |k(g) - k_found|² / |k_found|²  +  |g / usual|²

found by Levenberg-Marquardt from random wavefronts about as wide as the kernel. t is the log-likelihood of
Student's t: scenes have stripes that no polynomial follows. For the true wavefront the likelihood is best
where the scene's prior holds (`tests/lensmodel/test_blind_aberrations.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.blind.pupil import COMA, TERMS, Pupil
from lensmodel.blind.scene_spectra import SceneSpectra, log_power
from lensmodel.psf import as_kernel, centred, resized, rms_width
from lensmodel.types import Kernel, StepHook, ignore_step

_USUAL_PX = np.array([3.0, 2.0, 2.0, 3.0, 1.5, 1.5, 3.0, 3.0])
_TAILS = 6.0
_STRIDE_PX = 1.0
_ENOUGH = 0.05
_TRIES = 4
_SIDES: Final = (31, 47)
_WIDE_PX = 2.8

_USUAL_SHAPE = (0.4, 0.6, 0.6, 0.8, 0.6, 0.6)
"""Spread of the terms of a random wavefront, in widths of the kernel found; no tilts."""

_SEED = 0

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AberrationFit:
    """How to weigh spectra against the kernel found, and how long to search.

    Parameters
    ----------
    weight : float
        Of the kernel found.
    temper : float
        Share of the spectra's likelihood that counts: neighbouring bins err alike.
    starts : int
        Random wavefronts, each moved `approach` steps towards the kernel alone and `first` steps with
        the spectra.
    kept, rounds : int
        So many of the best go on for at most `rounds` steps.
    """

    weight: float = 20.0
    temper: float = 0.25
    starts: int = 24
    approach: int = 2
    first: int = 4
    kept: int = 8
    rounds: int = 12

    def fit(self, spectra: SceneSpectra, found: Kernel, on_step: StepHook = ignore_step) -> LocalWavefront:
        """Fit.

        Parameters
        ----------
        spectra : SceneSpectra
        found : Kernel
            Centred.
        on_step : StepHook
            Progress; raising `CancelledError` there stops the work.
        """
        wide = max(rms_width(found), 0.3)
        pupil = Pupil.of(_SIDES[wide > _WIDE_PX])
        aim = resized(found, pupil.size)
        rng = np.random.default_rng(_SEED)
        total = self.starts + self.kept + 1
        fits = []
        for done in range(self.starts):
            start = np.zeros(TERMS)
            start[: len(_USUAL_SHAPE)] = rng.standard_normal(len(_USUAL_SHAPE)) * _USUAL_SHAPE * wide
            near = self._descend(pupil, aim, start, None, self.approach)
            fits.append(self._descend(pupil, aim, near.terms, spectra, self.first))
            on_step(done + 1, total)
        best = min(fits, key=_cost)
        for done, fit in enumerate(sorted(fits, key=_cost)[: self.kept]):
            best = min(best, self._descend(pupil, aim, fit.terms, spectra, self.rounds), key=_cost)
            on_step(self.starts + done + 1, total)
        # The spectra of a kernel and of its turned copy are equal: only the kernel found tells.
        turned = best.terms.copy()
        turned[[*COMA, -2, -1]] *= -1.0
        best = min(best, self._descend(pupil, aim, turned, spectra, self.rounds // 2), key=_cost)
        on_step(total, total)
        return best

    def _descend(
        self, pupil: Pupil, aim: Kernel, terms: Floats, spectra: SceneSpectra | None, rounds: int
    ) -> LocalWavefront:
        state = self._state(pupil, aim, terms, spectra, None)
        damping = 1e-2
        for _ in range(rounds):
            better = None
            for _ in range(_TRIES):
                lifted = state.normal + np.diag(damping * np.diag(state.normal))
                step = np.linalg.solve(lifted, state.gradient)
                step *= min(1.0, _STRIDE_PX / max(float(np.abs(step[:TERMS]).max()), 1e-9))
                after = self._state(
                    pupil, aim, state.terms + step[:TERMS], spectra, state.amplitudes + step[TERMS:]
                )
                if after.cost < state.cost:
                    better = after
                    break
                damping *= 6.0
            if better is None:
                break
            gain, state = state.cost - better.cost, better
            damping /= 4.0
            if gain < _ENOUGH:
                break
        return LocalWavefront(state.terms, state.kernel, state.cost)

    def _state(
        self,
        pupil: Pupil,
        aim: Kernel,
        terms: Floats,
        spectra: SceneSpectra | None,
        amplitudes: Floats | None,
    ) -> _State:
        kernel, changes = pupil.kernel(terms)
        off, flat = (kernel - aim).ravel(), changes.reshape(TERMS, -1)
        weight = self.weight / float((aim**2).sum())
        usual = terms / _USUAL_PX
        cost = float(usual @ usual) + weight * float(off @ off)
        normal = np.diag(1.0 / _USUAL_PX**2) + weight * (flat @ flat.T)
        gradient = -usual / _USUAL_PX - weight * (flat @ off)
        if spectra is None:
            return _State(terms, np.zeros(0), kernel, cost, normal, gradient)
        blur, by_terms = log_power(kernel, changes)
        if amplitudes is None:
            amplitudes = spectra.begin(blur)
        left, change = spectra.residuals(blur, by_terms, amplitudes)
        cost += self.temper * (_TAILS + 1.0) * float(np.log1p(left**2 / _TAILS).sum())
        weighted = change * (self.temper * (_TAILS + 1.0) / (_TAILS + left**2))[:, None]
        every, pull = change.T @ weighted, -(weighted.T @ left)
        every[:TERMS, :TERMS] += normal
        pull[:TERMS] += gradient
        return _State(terms, amplitudes, kernel, cost, every, pull)


@dataclass(frozen=True, slots=True, eq=False)
class LocalWavefront:
    """A wavefront, pixels of blur by term, with its kernel where the pupil puts it, and its cost."""

    terms: Floats
    light: Floats
    cost: float

    @property
    def unusual(self) -> float:
        """What speaks against a wavefront before anything is seen, |g / usual|²."""
        return float(np.square(self.terms / _USUAL_PX).sum())

    def kernel(self, size: int) -> Kernel:
        """Kernel of odd side `size`, centred."""
        return resized(centred(as_kernel(self.light)), size)


def _cost(fit: LocalWavefront) -> float:
    return fit.cost


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    terms: Floats
    amplitudes: Floats
    kernel: Floats
    cost: float
    normal: Floats
    gradient: Floats
