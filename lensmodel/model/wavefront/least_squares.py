"""Least squares of a wavefront against samples: exact derivatives by its terms, differences by the pupil.

Each sample may move by a fraction of a pixel: its tilts are eliminated before the step. Starts come
from the moments of the samples (`starts`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.descent import Descent
from lensmodel.core.psf import PsfSample, resized
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.wavefront import NAMES, Wavefront, design, stopped

Floats = NDArray[np.float64]

_NOISE = 0.1
"""Relative L2 that a good sample has against the best wavefront: more gives the prior of aberrations a larger
part, less none (chosen)."""
_HUBER = 0.35  # relative error: that of a usual estimate (chosen)
_ENOUGH = 2e-3  # of the cost: less gained in a step ends the fit (chosen)
# Of the differences that stand for derivatives: by the cat's eye, whose edge is one sample of the pupil wide,
# and by the width of diffraction (chosen)
_EYE_STEP, _LOG_Q_STEP = 0.02, 0.05
_TRIES = 4  # steps with more damping before the fit ends: by then they are too short to gain (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class _FrontFit:
    """A wavefront with the tilts of its samples, and which way down."""

    front: Wavefront
    tilts: Floats
    cost: float
    normal: Floats
    gradient: Floats
    errors: Floats  # relative L2 of each sample
    follows: list[tuple[Floats, Floats]]  # how the tilts of each sample follow a step


@dataclass(frozen=True, slots=True, eq=False)
class WavefrontProblem:
    """Least squares of a wavefront against samples, both blurred alike."""

    samples: tuple[PsfSample, ...]
    size: int
    log_q: float
    vague: float  # standard deviation of log q about `log_q`
    blur_px: float

    def solve(self, begin: Wavefront, rounds: int) -> tuple[Wavefront, float, Floats]:
        """Levenberg-Marquardt; returns the wavefront, its cost and each sample's relative L2."""
        wanted = [self._soft(resized(s.kernel, self.size)) for s in self.samples]
        norms = np.array([np.linalg.norm(w) for w in wanted])
        votes = np.array([s.weight for s in self.samples])
        designs = [design(s.position, s.settings) for s in self.samples]

        def moved(state: _FrontFit, step: Floats) -> _FrontFit:
            tilts = state.tilts + np.stack([-(a + b @ step) for a, b in state.follows])
            return self._linearised(_moved(state.front, step), tilts, designs, wanted, norms, votes)

        descent = Descent(rounds, _TRIES, enough_of_cost=_ENOUGH, raised=8.0, lowered=5.0)
        state = self._linearised(begin, self._tilts(begin), designs, wanted, norms, votes)
        state = descent.down(state, moved)
        return state.front, state.cost, state.errors

    def _soft(self, kernel: Floats) -> Floats:
        if self.blur_px == 0.0:
            return np.asarray(kernel)
        return np.asarray(
            ndimage.gaussian_filter(kernel, self.blur_px, axes=(-2, -1), mode="constant", truncate=3.0)
        )

    def _tilts(self, front: Wavefront) -> Floats:
        tilts = []
        for s in self.samples:
            grid = front.grid(s.settings)
            amplitude = front.amplitude(grid, s.position, s.settings, front.eye)
            tilts.append(-np.array(grid.centre(front.blur(s.position, s.settings), amplitude)))
        return np.array(tilts)

    def _linearised(
        self,
        front: Wavefront,
        tilts: Floats,
        designs: Sequence[Floats],
        wanted: Sequence[Floats],
        norms: Floats,
        votes: Floats,
    ) -> _FrontFit:
        """Cost about a wavefront, and its normal equations."""
        slopes = np.empty(0) if front.slopes is None else front.slopes
        count = len(NAMES) + 3 + slopes.size  # log q and the cat's eye
        precision = np.concatenate(
            [
                ABERRATIONS.with_kernels**-2.0,
                [self.vague**-2.0],
                np.array(ABERRATIONS.eye_spread) ** -2.0,
                ABERRATIONS.slopes[: slopes.size] ** -2.0,
            ]
        )
        apart = np.concatenate(
            [front.terms, [front.log_q - self.log_q], np.subtract(front.eye, ABERRATIONS.eye), slopes]
        )
        normal, uphill = np.diag(precision), precision * apart
        cost = float(precision @ apart**2)
        errors, locals_ = np.zeros(len(self.samples)), []
        for i, s in enumerate(self.samples):
            light, columns, moves = self._columns(front, s, tilts[i], designs[i])
            miss = (light - wanted[i].ravel()) / norms[i]
            columns, moves = columns / norms[i], moves / norms[i]
            within = np.linalg.inv(moves @ moves.T + 1e-9 * np.eye(2)) @ moves
            own, follows = within @ miss, within @ columns.T
            free = miss - own @ moves
            errors[i] = np.linalg.norm(free)
            # Huber: beyond _HUBER the cost grows linearly
            trust = votes[i] * min(1.0, _HUBER / max(errors[i], 1e-12)) / _NOISE**2
            clean = columns - follows.T @ moves
            normal += trust * (clean @ clean.T)
            uphill += trust * (clean @ free)
            flat = errors[i] ** 2 if errors[i] <= _HUBER else _HUBER * (2 * errors[i] - _HUBER)
            cost += votes[i] * flat / _NOISE**2
            locals_.append((own, follows))
        assert normal.shape == (count, count)
        return _FrontFit(front, tilts, cost, normal, -uphill, errors, locals_)

    def _columns(
        self,
        front: Wavefront,
        sample: PsfSample,
        tilt: Floats,
        linear: Floats,
    ) -> tuple[Floats, Floats, Floats]:
        """Kernel of sum 1, its derivatives by the unknowns (count, k^2) and by the tilts (2, k^2)."""
        settings, position = sample.settings, sample.position
        grid = front.grid(settings)
        radius, shift = front.eye
        amplitude = front.amplitude(grid, position, settings, front.eye)
        wider = front.amplitude(grid, position, settings, (radius + _EYE_STEP, shift)) - amplitude
        further = front.amplitude(grid, position, settings, (radius, shift + _EYE_STEP)) - amplitude
        g = front.blur(position, settings)
        g[6:] = tilt
        light, derivatives = grid.with_derivatives(g, amplitude, (wider / _EYE_STEP, further / _EYE_STEP))
        softer = replace(front, log_q=front.log_q + _LOG_Q_STEP).grid(settings)
        broad = softer.light(g, front.amplitude(softer, position, settings, front.eye))
        by_q = (broad / broad.sum() * light.sum() - light) / _LOG_Q_STEP
        stack = self._soft(np.concatenate([derivatives, by_q[None], light[None]]))
        flat = stack.reshape(len(stack), -1)
        total = light.sum()
        sums = np.concatenate([derivatives.sum(axis=(1, 2)), [by_q.sum()]])
        kernel = flat[-1] / total
        normalised = flat[:-1] / total - np.outer(sums / total, kernel)
        terms = stopped(linear, front.stop(settings)).T @ normalised[:6]
        columns = [terms, normalised[[10, 8, 9]]]
        if front.slopes is not None:
            columns.append(terms * front.octaves(settings))
        return kernel, np.concatenate(columns), normalised[6:8]


def _moved(front: Wavefront, step: Floats) -> Wavefront:
    n = len(NAMES)
    q = float(np.clip(front.log_q + step[n], math.log(0.1), math.log(12.0)))
    eye = (max(front.eye[0] + float(step[n + 1]), 0.4), front.eye[1] + float(step[n + 2]))
    slopes = None if front.slopes is None else front.slopes + step[n + 3 :]
    return replace(front, terms=front.terms + step[:n], log_q=q, eye=eye, slopes=slopes)
