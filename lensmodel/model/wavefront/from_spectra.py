"""One wavefront fitted to the spectra of all patches of all photos of a lens.

Finished kernels keep the error that each patch made on its own: the scene's slope taken for blur. Here
the scene of each patch, and what a photo's patches share, stay unknown beside the few numbers of the
lens, and all of them are estimated at once (P. Whittle's idea, with log spectra in bins and Student's t
against outliers), so that photos add up::

    minimise  sum_patches rho(chi^2)  +  |priors|^2,
    chi^2 = sum_bins t(r' V^-1 r),
    r = ln S - ln(exp(s(z) + b + d |OTF(theta)|^4) (|OTF(theta)|^2 + exp(w)) + n)

by Levenberg-Marquardt, the unknowns z and w of a patch eliminated from the normal equations (Schur). Power
knows nothing of the phase: a wavefront and its negative, which turns the kernels by 180 degrees, have
equal spectra. Which of the two it is has to come from elsewhere: from phases between colours (`phase_costs`)
and the patches' tails (`joint_kernels`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.cross_phase import unshifted, without_linear
from lensmodel.core.descent import Descent
from lensmodel.core.files import fitted
from lensmodel.core.spectrum import PHASE_BINS, SECTORS, CrossPhase
from lensmodel.core.types import WAVELENGTH_NM, Channel, FieldPosition, LensSettings, StepHook, ignore_step
from lensmodel.model.wavefront.scene_fit import SceneState
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.optics.aberration_prior import unlikeliness
from lensmodel.optics.transfer import BINS, Transfer, phase_between
from lensmodel.optics.wavefront import NAMES, Wavefront, design, stopped
from lensmodel.scene.prior import BORROWED_RINGS, PATCH_SHAPES, PATCHES

Floats = NDArray[np.float64]

_RINGS = BINS // SECTORS
_LENS = len(NAMES) + 2  # and the cat's eye
SYMMETRIC: Final = np.array(
    [name in {"spherical", "coma", "focus", "field curvature", "astigmatism"} for name in NAMES] + [False] * 2
)
"""Which unknowns a centred lens of third order has in one colour."""

_HELD = 1e12  # inverse variance of an unknown that is to stay: beyond any that data give
_TEMPER = 0.1
"""Share of the likelihood that counts (chosen): neighbouring bins and patches of one motif err alike."""

_PHASES: Final[Mapping[str, float]] = fitted("model")["phases"]
"""Scatter in radians and temper of phases, see `data/README.md`."""

PATCH_TAILS: Final = 3.0
"""Degrees of freedom of Student's t of a patch, in units of its bins (chosen): a patch that something else
blurred loses its say, an unusual one keeps it."""

_HELD_ROUNDS = 3
"""Steps of what photos share behind a lens that is known: few unknowns, and nearly linear (chosen)."""
_TRIES = 5  # steps with more damping before the fit ends: by then they are too short to gain (chosen)
_STRIDE_PX = 1.5  # pixels of blur: no term changes by more in one step (chosen)
_ENOUGH = 0.2  # of the cost: less gained in a step ends the fit; minima differ by more (chosen)
_SMALLEST_EYE, _FARTHEST_EYE = 0.5, 1.0  # radius, shift: the circles overlap all over the field (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PatchView:
    """One patch: where, how the lens was set, of which photo, its spectra, its phases against green.

    Phases are observations of a fit as spectra are, and judge fits made without them (`phase_costs`).
    """

    position: FieldPosition
    settings: LensSettings
    photo: str
    scene: SceneView
    phases: Mapping[Channel, CrossPhase] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class PooledFit:
    """A fitted lens.

    Parameters
    ----------
    front : Wavefront
    cost : float
        What was minimised; fits to the same patches compare by it.
    covariance : ndarray, shape (21, 21)
        Of the 19 terms and the cat's eye, by the curvature of the cost.
    trust : ndarray, shape (n,)
        Weight of each patch, 1 where it fits; near 0 for one that was blurred by something else.
    """

    front: Wavefront
    cost: float
    covariance: Floats
    trust: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _PooledState:
    """A lens with what its photos share, and how well it explains all patches."""

    lens: Floats
    shared: Floats  # what the patches of each photo share
    cost: float
    normal: Floats
    gradient: Floats
    scenes: list[Floats]
    trust: Floats


def fit_spectra(
    patches: Sequence[PatchView],
    begin: Wavefront,
    *,
    rounds: int = 15,
    symmetric: bool = False,
    coarse: bool = False,
    on_step: StepHook = ignore_step,
) -> PooledFit:
    """Fit a lens to patches, beginning with a wavefront.

    Parameters
    ----------
    patches : sequence of PatchView
    begin : Wavefront
        `log_q`, `f_number` and `size` stay as they are here.
    rounds : int
        Steps at most.
    symmetric : bool
        Whether only the terms of a perfectly centred lens may change: few unknowns have few minima.
    coarse : bool
        Whether a coarse pupil does; such costs compare only among each other.
    """
    photos = sorted({patch.photo for patch in patches})
    problem = _PooledProblem(tuple(patches), {name: i for i, name in enumerate(photos)}, begin, coarse)
    lens = np.concatenate([begin.terms, open_eye(np.asarray(begin.eye))])
    shared = np.zeros((len(photos), len(PATCHES.photo_spread)))
    held = np.zeros(_LENS + shared.size)
    held[:_LENS] = np.where(SYMMETRIC, 0.0, _HELD) if symmetric else 0.0
    descent = Descent(rounds, _TRIES, enough=_ENOUGH)
    state = descent.down(
        problem.state(lens, shared, None),
        problem.moved,
        held=held,
        on_round=lambda done: on_step(done, rounds),
    )
    on_step(rounds, rounds)
    covariance = np.asarray(np.linalg.inv(state.normal), dtype=np.float64)[:_LENS, :_LENS]
    return PooledFit(problem.front(state.lens), state.cost, covariance, state.trust)


def held_cost(patches: Sequence[PatchView], front: Wavefront) -> float:
    """What patches cost behind a lens that was made without them; what those of a photo share is fitted."""
    photos = sorted({patch.photo for patch in patches})
    problem = _PooledProblem(tuple(patches), {name: i for i, name in enumerate(photos)}, front, coarse=False)
    lens = np.concatenate([front.terms, open_eye(np.asarray(front.eye))])
    shared = np.zeros((len(photos), len(PATCHES.photo_spread)))
    held = np.zeros(_LENS + shared.size)
    held[:_LENS] = _HELD
    state = Descent(_HELD_ROUNDS, _TRIES, enough=_ENOUGH).down(
        problem.state(lens, shared, None), problem.moved, held=held
    )
    return state.cost - unlikeliness(lens)[0]


def open_eye(eye: Floats) -> tuple[float, float]:
    """Nearest cat's eye, radius and shift, that leaves light everywhere in the field."""
    return max(float(eye[0]), _SMALLEST_EYE), float(np.clip(eye[1], -_FARTHEST_EYE, _FARTHEST_EYE))


def phase_costs(patches: Sequence[PatchView], front: Wavefront) -> tuple[float, float]:
    """What the phases of patches cost behind a lens, and behind the same turned by 180 degrees.

    Turned, a lens has the opposite phases. Costs are in the units of a fit's, and add to it. Neither is more
    than without any phase: power tells little of the focus of colours, and phases of a lens that suit worse
    than none say nothing of it.
    """
    lens = np.concatenate([front.terms, open_eye(np.asarray(front.eye))])
    own = turned = none = 0.0
    for patch in patches:
        if patch.phases:
            for channel, (phase, by_phase) in expected(front, lens, patch)[2].items():
                seen = patch.phases[channel]
                own += phase_terms(seen, phase, by_phase)[0]
                turned += phase_terms(seen, -phase, by_phase)[0]
                none += phase_terms(seen, np.zeros_like(phase), by_phase)[0]
    return min(own, none), min(turned, none)


@dataclass(frozen=True, slots=True, eq=False)
class _PooledProblem:
    """The patches of all photos, and where the fit to them begins."""

    patches: tuple[PatchView, ...]
    photos: dict[str, int]
    begin: Wavefront
    coarse: bool

    def front(self, lens: Floats) -> Wavefront:
        """Wavefront of the unknowns."""
        eye = (float(lens[-2]), float(lens[-1]))
        return replace(self.begin, terms=lens[: len(NAMES)].copy(), eye=eye)

    def moved(self, state: _PooledState, step: Floats) -> _PooledState:
        """Where a step leads, made shorter if it is too bold."""
        step = step * min(1.0, _STRIDE_PX / max(float(np.abs(step[: len(NAMES)]).max()), 1e-9))
        lens = state.lens + step[:_LENS]
        lens[-2:] = open_eye(lens[-2:])
        return self.state(lens, state.shared + step[_LENS:].reshape(state.shared.shape), state.scenes)

    def state(self, lens: Floats, shared: Floats, scenes: list[Floats] | None) -> _PooledState:
        """Cost with its normal equations; `scenes` are the patches' unknowns to begin with."""
        count = _LENS + shared.size
        normal, gradient = np.zeros((count, count)), np.zeros(count)
        cost, scenes_after, trust = 0.0, [], []
        for i, patch in enumerate(self.patches):
            at = _LENS + len(PATCHES.photo_spread) * self.photos[patch.photo]
            seen, by_lens, phases = expected(self.begin, lens, patch, coarse=self.coarse)
            # its change with the lens is no part of the derivatives: lenses far too sharp would gain by it
            rest = (PATCHES.bias + PATCH_SHAPES[:, 1:3] @ shared[self.photos[patch.photo]])[:, None]
            rest = rest + PATCHES.with_power[:, None] * seen**2
            z = None if scenes is None else scenes[i]
            fitted = SceneState.fitted(patch.scene, seen, rest, z)
            nu = PATCH_TAILS * BINS * len(patch.scene.channels)
            cost += _TEMPER * nu * math.log1p(fitted.cost / nu)
            trusted = 1.0 / (1.0 + fitted.cost / nu)
            weight = _TEMPER * trusted
            own_normal, own_gradient, own_count = fitted.reduced(by_lens)
            places = [*range(_LENS), *range(at, at + own_count - _LENS)]
            normal[np.ix_(places, places)] += weight * own_normal
            gradient[places] += weight * own_gradient
            for channel, (phase, by_phase) in phases.items():
                phase_cost, by_both, downhill = phase_terms(patch.phases[channel], phase, by_phase)
                cost += phase_cost
                normal[:_LENS, :_LENS] += by_both
                gradient[:_LENS] += downhill
            scenes_after.append(fitted.z)
            trust.append(trusted)
        unusual, curvature, pull = unlikeliness(lens)
        vote = np.tile(1.0 / PATCHES.photo_spread**2, len(self.photos))
        cost += unusual + float(vote @ shared.ravel() ** 2)
        normal[:_LENS, :_LENS] += curvature
        normal[range(_LENS, count), range(_LENS, count)] += vote
        gradient -= np.concatenate([pull, vote * shared.ravel()])
        return _PooledState(lens, shared, cost, normal, gradient, scenes_after, np.array(trust))


def expected(
    begin: Wavefront, lens: Floats, patch: PatchView, *, coarse: bool = False
) -> tuple[Floats, Floats, dict[Channel, tuple[Floats, Floats]]]:
    """What a patch should show behind a lens.

    Parameters
    ----------
    begin : Wavefront
        Its width of diffraction and widest aperture count.
    lens : ndarray, shape (21,)
        Terms and cat's eye.
    patch : PatchView
    coarse : bool
        See `fit_spectra`.

    Returns
    -------
    power : ndarray, shape (BINS, c)
        |OTF|^2.
    by_lens : ndarray, shape (BINS, c, 21)
        Derivatives of its logarithm.
    phases : dict
        Of each channel compared with green: phases, (PHASE_BINS,), and derivatives, (PHASE_BINS, 21).
    """
    x = patch.position.r * math.cos(patch.position.phi)
    y = patch.position.r * math.sin(patch.position.phi)
    values, derivatives = [], []
    waves: dict[Channel, tuple[Transfer, NDArray[np.complex128], Floats]] = {}
    for channel in patch.scene.channels:
        settings = patch.settings.with_channel(channel)
        stop = begin.stop(settings)
        q = math.exp(begin.log_q) * WAVELENGTH_NM[channel] / WAVELENGTH_NM["g"] / stop
        linear = stopped(design(patch.position, settings), stop)
        radius, move = lens[-2] / stop, lens[-1] / stop
        transfer = Transfer.of(q, _RINGS if channel == "g" else _RINGS - BORROWED_RINGS, coarse=coarse)
        wave = transfer.waves(linear @ lens[: len(NAMES)], radius, (move * x, move * y))
        value, by_blur, by_eye = transfer.log_power_of(wave)
        by_own = np.zeros((9, _LENS))  # what blur and cat's eye of this place and channel are of the lens
        by_own[:6, : len(NAMES)] = linear
        by_own[6, -2], by_own[7, -1], by_own[8, -1] = 1.0 / stop, x / stop, y / stop
        values.append(np.exp(value))
        derivatives.append(np.concatenate([by_blur, by_eye], axis=1) @ by_own)
        waves[channel] = transfer, wave, by_own
    phases = {}
    for channel in patch.phases:
        (own, wave, by_own), (green, light, by_green) = waves[channel], waves["g"]
        phase, by_channel, by_light = phase_between(own, wave, green, light)
        phases[channel] = phase, by_channel @ by_own + by_light @ by_green
    return np.stack(values, axis=1), np.stack(derivatives, axis=1), phases


def phase_terms(
    seen: CrossPhase, phase: Floats, by_lens: Floats, temper: float = _PHASES["temper"]
) -> tuple[float, Floats, Floats]:
    """Cost of phases with its normal equations and gradient, after the shift that suits best.

    It is nu ln(1 + chi^2 / nu) with chi^2 = sum 2 p (1 - cos(seen - phase - 2 pi f.s)), times `temper`.
    """
    precision = seen.precision / (1.0 + seen.precision * _PHASES["scatter"] ** 2)
    left = unshifted(CrossPhase(seen.phase, precision), phase)
    chi2 = float(2.0 * precision @ (1.0 - np.cos(left)))
    nu = PATCH_TAILS * PHASE_BINS
    weight = temper / (1.0 + chi2 / nu)
    free = without_linear(by_lens, precision)
    voted = precision[:, None] * free
    return temper * nu * math.log1p(chi2 / nu), weight * free.T @ voted, weight * voted.T @ np.sin(left)
