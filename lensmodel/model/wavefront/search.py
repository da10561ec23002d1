"""Where the fit of a wavefront to spectra begins, and which of the minima it ends in is the lens.

A fit walks downhill, and there are many hills. So all patches are searched from many beginnings (`search`):
coarsely and centred in green, the best of those with all terms, the best of these in all colours. What many
photos make likely in green can all lie in minima that are not the deepest of all colours together; so pairs
of photos are searched in green too, and what single photos or an earlier version of the fit came to is
another beginning, and the best lens with its field centred elsewhere.

Of the minima that differ the likeliest is taken, and how well each foretells patches that were left out
counts as much as how well it fits (`held_out`): a wrong lens can fit all patches and foretell none.
A half is fitted on from the fit to all, so that patches left out had a say in where it begins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import Channel, StepHook, ignore_step
from lensmodel.model.wavefront.from_spectra import PatchView, PooledFit, fit_spectra, held_cost
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.wavefront import NAMES, Wavefront

Group: TypeAlias = dict[Channel, PsfSample]
"""Samples of one patch in its channels."""

MOST_PATCHES: Final = 48
"""Patches that a fit looks at in all colours: the cost grows with them (chosen: those of two photos)."""

_COMA = slice(2, 6)  # the odd terms of `NAMES`
# Patches of the first two stages (chosen: those of a photo, of one and a half)
_COARSE_PLACES, _MEDIUM_PLACES = 24, 36
# Steps at most: only the last fit has to end (chosen)
_COARSE_ROUNDS, _MEDIUM_ROUNDS, _FINE_ROUNDS, _HELD_ROUNDS = 7, 6, 16, 5
# Minima kept of the coarse search, and those fitted in full (chosen: each of the last costs seconds)
_KEPT, _REFINED, _REFINED_OF_PAIR = 12, 4, 2
_FEWEST_PAIRED, _MOST_PAIRS = 3, 2  # photos, and pairs of them (chosen: two photos are a pair themselves)
_RANDOM = 24
"""Random wavefronts to begin with: enough to meet minima that nothing else leads to; each costs a few steps
(chosen)."""
_SAME_PX = 0.4  # pixels of blur: terms nearer than that lie in one minimum (chosen)
_ASIDE, _DIRECTIONS = 0.35, 8
"""Half-diagonals by which a field is centred elsewhere, and ways to go: as much as a badly decentred lens is
off, in steps of 45 degrees (chosen)."""
_SEED = 0  # any number: fits repeat to the bit


@dataclass(slots=True, eq=False)
class _Steps:
    """Progress of a search in steps of fits."""

    on_step: StepHook
    total: int
    done: int = field(default=0)

    def add(self, count: int) -> None:
        self.done = min(self.done + count, self.total)
        self.on_step(self.done, self.total)


def search(
    groups: Sequence[Group],
    parts: Sequence[Sequence[Group]],
    begins: Sequence[Wavefront],
    known: Sequence[Wavefront] = (),
    on_step: StepHook = ignore_step,
) -> list[PooledFit]:
    """Find the minima of the fit to all patches, the likeliest first.

    Parameters
    ----------
    groups : sequence of Group
        The patches, the first of them far from each other.
    parts : sequence of sequence of Group
        Those of pairs of photos.
    begins : sequence of Wavefront
        For the coarse search.
    known : sequence of Wavefront
        Lenses to begin with in full: of single photos, or an earlier version of the fit.
    """
    in_green = len(begins) * _COARSE_ROUNDS + 2 * _KEPT * _MEDIUM_ROUNDS
    ends = _REFINED + len(parts) * _REFINED_OF_PAIR + len(known) + 1
    steps = _Steps(on_step, (1 + len(parts)) * in_green + ends * _FINE_ROUNDS)
    fronts = _in_green(groups, begins, steps)[:_REFINED]
    for part in parts:
        fronts += _in_green(part, begins, steps)[:_REFINED_OF_PAIR]
    fits = [_fine(groups, front, steps) for front in (*fronts, *known)]
    fits.append(_fine(groups, _decentred(groups, min(fits, key=_cost).front), steps))
    on_step(steps.total, steps.total)
    return _different(fits)


def held_out(groups: Sequence[Group], front: Wavefront) -> float:
    """What each half of the patches costs behind the lens that the other half makes of a wavefront.

    In the units of a fit's cost; it compares among wavefronts of the same patches.
    """
    total = 0.0
    for half in (0, 1):
        seen = [without_phases(group) for k, group in enumerate(groups) if k % 2 == half]
        others = [without_phases(group) for k, group in enumerate(groups) if k % 2 != half]
        if seen and others:
            total += held_cost(others, fit_spectra(seen, front, rounds=_HELD_ROUNDS).front)
    return total


def pairs(samples: Sequence[PsfSample]) -> list[list[PsfSample]]:
    """Samples of the first photos two by two, of three photos or more, whatever their order."""
    photos = sorted({s.photo for s in samples})
    if len(photos) < _FEWEST_PAIRED:
        return []
    sets = [set(photos[i : i + 2]) for i in range(0, len(photos) - 1, 2)][:_MOST_PAIRS]
    return [[s for s in samples if s.photo in pair] for pair in sets]


def random_fronts(first: Wavefront, width: float) -> list[Wavefront]:
    """Draw centred lenses that blur about as much as the samples.

    Kernels that were estimated one by one have the widths of the lens, not always its character: where
    spherical aberration is balanced by focus, their moments lead elsewhere.
    """
    rng, fronts = np.random.default_rng(_SEED), []
    for _ in range(_RANDOM):
        terms = np.zeros(len(NAMES))
        for name, usual in ABERRATIONS.drawn.items():
            terms[NAMES.index(name)] = rng.normal(0.0, usual)
        balance = ABERRATIONS.balance * terms[NAMES.index("spherical")]
        terms[NAMES.index("focus")] = balance + rng.normal(0.0, ABERRATIONS.drawn_balance)
        fronts.append(replace(first, terms=width * terms, eye=ABERRATIONS.eye))
    return fronts


def view(group: Group) -> PatchView:
    """What a patch shows in its channels."""
    head = next(iter(group.values()))
    spectra = {c: group[c].spectrum for c in ("g", "r", "b") if c in group}
    scene = SceneView.of({c: s for c, s in spectra.items() if s is not None})
    phases = {
        c: s.cross for c, s in spectra.items() if s is not None and s.cross is not None and "g" in group
    }
    return PatchView(head.position, head.settings, head.photo, scene, phases)


def without_phases(group: Group) -> PatchView:
    """The same without phases: a lens and its negative are one minimum to a search."""
    return replace(view(group), phases={})


def _in_green(groups: Sequence[Group], begins: Sequence[Wavefront], steps: _Steps) -> list[Wavefront]:
    """Fit green from many starts, coarsely and centred, then the best with all terms; the best first.

    Where the pupil is round, a wavefront whose coma is negated has the same spectra as before. Only the
    cat's eye tells the two apart, so that both are tried.
    """
    green = [without_phases({"g": group["g"]}) for group in groups if "g" in group][:_MEDIUM_PLACES]
    coarse = []
    for begin in begins:
        coarse.append(
            fit_spectra(green[:_COARSE_PLACES], begin, rounds=_COARSE_ROUNDS, symmetric=True, coarse=True)
        )
        steps.add(_COARSE_ROUNDS)
    medium = []
    for fit in _different(coarse)[:_KEPT]:
        for front in (fit.front, _mirrored(fit.front)):
            medium.append(fit_spectra(green, front, rounds=_MEDIUM_ROUNDS))
            steps.add(_MEDIUM_ROUNDS)
    return [fit.front for fit in _different(medium)]


def _fine(groups: Sequence[Group], front: Wavefront, steps: _Steps) -> PooledFit:
    """Fit all colours of patches."""
    fit = fit_spectra([without_phases(group) for group in groups], front, rounds=_FINE_ROUNDS)
    steps.add(_FINE_ROUNDS)
    return fit


def _decentred(groups: Sequence[Group], front: Wavefront) -> Wavefront:
    """The lens with its field centred elsewhere, in the direction that costs least.

    With the center at c, a term a |x|^2 is a |x|^2 - 2 a c.x + a |c|^2, and likewise the others (nodal
    aberration theory: K. Thompson, "Description of the third-order optical aberrations of near-circular pupil
    optical systems without symmetry", JOSA A 22, 2005).
    """
    views = [without_phases(group) for group in groups]
    angles = 2.0 * math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    moved = [_moved(front, _ASIDE * math.cos(angle), _ASIDE * math.sin(angle)) for angle in angles]
    return min(moved, key=lambda one: fit_spectra(views, one, rounds=0).cost)


def _moved(front: Wavefront, x: float, y: float) -> Wavefront:
    """The terms of third order with the center of the field at (x, y), half-diagonals right and up."""
    terms = dict(zip(NAMES, front.terms.tolist(), strict=True))
    curved, coma, astigmatic = (terms[name] for name in ("field curvature", "coma", "astigmatism"))
    terms["focus"] += curved * (x * x + y * y)
    terms["tilt x"] -= 2.0 * curved * x
    terms["tilt y"] -= 2.0 * curved * y
    terms["uniform coma x"] -= coma * x
    terms["uniform coma y"] -= coma * y
    terms["linear astigmatism 1"] -= 2.0 * astigmatic * x
    terms["linear astigmatism 2"] -= 2.0 * astigmatic * y
    terms["uniform astigmatism 1"] += astigmatic * (x * x - y * y)
    terms["uniform astigmatism 2"] += 2.0 * astigmatic * x * y
    return replace(front, terms=np.array([terms[name] for name in NAMES]))


def _mirrored(front: Wavefront) -> Wavefront:
    """Negate the coma."""
    terms = front.terms.copy()
    terms[_COMA] *= -1.0
    return replace(front, terms=terms)


def _cost(fit: PooledFit) -> float:
    return fit.cost


def _different(fits: Sequence[PooledFit]) -> list[PooledFit]:
    """Fits that ended in different minima, the best first; a wavefront and its negative count as one.

    Their costs say nothing of that: unlike lenses can be about as likely.
    """
    kept: list[PooledFit] = []
    for fit in sorted(fits, key=_cost):
        if all(_apart(fit.front.terms, other.front.terms) > _SAME_PX for other in kept):
            kept.append(fit)
    return kept


def _apart(terms: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    return float(min(np.abs(terms - others).max(), np.abs(terms + others).max()))
