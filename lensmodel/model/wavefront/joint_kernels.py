"""The kernels of all samples of a lens, solved together from their spectra.

A wavefront is fitted to the spectra of all patches (`fit`), beginning with fits to the samples' own kernels
and to their moments; the side of the tails is decided by the patches' vote (`PatchSpectrum.tail`) and, where
a photo's mosaic is known, by the phases of red and blue against green.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.psf import PsfSample, distance, rms_width
from lensmodel.core.types import WAVELENGTH_NM, Channel, FieldPosition, Kernel, StepHook, ignore_step
from lensmodel.model.wavefront.from_kernels import USUAL_PITCH_UM, fit_wavefront, side_of_light, spread
from lensmodel.model.wavefront.from_spectra import (
    SYMMETRIC,
    PatchView,
    PooledFit,
    fit_spectra,
    open_eye,
    phase_costs,
)
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.model.wavefront.starts import starts
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.wavefront import NAMES, Wavefront, design, stopped

MIN_PLACES: Final = 8
"""Fewer patches with a spectrum are not solved together (chosen: a third of those of a photo)."""

Group: TypeAlias = dict[Channel, PsfSample]
"""Samples of one patch in its channels."""

_COMA = slice(2, 6)  # the odd terms of `NAMES`
# Patches that a search looks at coarsely, in green, and in full: the cost grows with them (chosen: those of
# one photo, of one and a half, of two)
_COARSE_PLACES, _MEDIUM_PLACES, _FINE_PLACES = 24, 36, 48
_NARROW_PLACES, _STOPPED_DOWN = 24, 2.0
"""Patches at most of photos stopped down, and the multiple of the widest f-number from which on they are (two
stops). With all of them, five such photos take back what one adds (`lensmodel.lab.chain.stopped_down`)."""
# Steps at most: only the last fit has to end (chosen)
_COARSE_ROUNDS, _MEDIUM_ROUNDS, _FINE_ROUNDS = 7, 6, 16
# Starts by moments, minima kept of the coarse search, and those fitted in full, of all photos and of a pair
# (chosen: each of the last costs seconds)
_STARTS, _KEPT, _REFINED, _REFINED_OF_PAIR = 6, 12, 4, 2
_FEWEST_PAIRED, _MOST_PAIRS = 3, 2  # photos, and pairs of them (chosen: two photos are a pair themselves)
_FIRST, _RANDOM = 16, 24  # samples of the first fit to kernels, and random wavefronts to begin with (chosen)
_SAME_PX = 0.4  # pixels of blur: terms nearer than that lie in one minimum (chosen)
_TAIL_SIDE = 31  # pixels of kernels whose third moments count: wider wings are noise to them (chosen)
# Places and draws that tell the scatter: each draw costs a kernel a place (chosen)
_ERROR_PLACES, _DRAWS = 14, 6
_ALIKE_R = 0.15  # half-diagonals: the scatter changes no faster over the field (chosen)
_SEED = 0  # any number: fits repeat to the bit
_ERROR: Final[Mapping[str, float]] = fitted("model")["pooled_error"]
"""Constants of `Pooled.errors`: share of the scatter of draws that is told of one photo, the least of what n
photos leave of it, and what more patches do not mend, at r = 0 and by r; see `data/README.md`. The corners of
a single photo may be soft by themselves; what several agree on is nearer to the truth.

The figures were chosen on 21 fits of simulated lenses of development seeds (0 to 30, one photo to five):
with them 44 % of the places are told within a factor of 1.5, 43 % with each lens left out in turn, and no
rule of width, radius, number of photos and covariance that was tried told more than 46 %.
`python -m lensmodel.lab.model.pooled_evidence` prints how often they do.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Pooled:
    """A lens that all patches agree on.

    Parameters
    ----------
    fit : PooledFit
    tails : float
        Vote of the patches for the side of the tails, by tails and phases, in standard deviations; its sign
        was obeyed.
    trust : dict
        Median weight of each photo's patches; near 0 where something other than the lens blurred.
    diffraction_known : bool
        Whether samples name aperture and pixel pitch.
    """

    fit: PooledFit
    tails: float
    trust: dict[str, float]
    diffraction_known: bool

    @property
    def front(self) -> Wavefront:
        """The wavefront."""
        return self.fit.front

    @property
    def turned(self) -> float:
        """Probability that the side of the tails is the wrong one: one half where no patch voted.

        A weak vote is taken as it is. Of five single photos of a lens with strong coma all votes were right,
        two of them of no more than 0.3 standard deviations.
        """
        return 0.5 if self.tails == 0.0 else 0.0

    def kernel(self, sample: PsfSample, size: int) -> Kernel:
        """Kernel at the place and settings of a sample."""
        return self.front.kernel(sample.position, sample.settings, size)

    def errors(self, samples: Sequence[PsfSample]) -> NDArray[np.float64]:
        """Expected relative L2 of the kernels at samples, shape (n,).

        hypot(0.7 c d, 0.07 exp(1.5 r)), with d the scatter of draws from the fit's covariance and c one over
        the number of photos, 0.3 at least.
        """
        few = spread(samples, _ERROR_PLACES)
        rng = np.random.default_rng(_SEED)
        lens = np.concatenate([self.front.terms, self.front.eye])
        values, vectors = np.linalg.eigh(self.fit.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        squared = np.zeros(len(few))
        right = [self.front.kernel(s.position, s.settings, _TAIL_SIDE) for s in few]
        for _ in range(_DRAWS):
            drawn = lens + root @ rng.standard_normal(len(lens))
            other = replace(self.front, terms=drawn[:-2], eye=open_eye(drawn[-2:]))
            squared += [
                distance(other.kernel(s.position, s.settings, _TAIL_SIDE), k).rel_l2 ** 2
                for s, k in zip(few, right, strict=True)
            ]
        here = np.array([_vector(s) for s in samples])
        there = np.array([_vector(s) for s in few])
        apart = ((here[:, None] - there[None]) ** 2).sum(axis=-1)
        weight = np.exp(-0.5 * apart / _ALIKE_R**2) + 1e-9
        drawn_here = weight @ np.sqrt(squared / _DRAWS) / weight.sum(axis=1)
        least = _ERROR["at_center"] * np.exp([_ERROR["by_radius"] * s.position.r for s in samples])
        photos = max(len({s.photo for s in samples}), 1)
        share = _ERROR["drawn"] * max(1.0 / photos, _ERROR["least_drawn"])
        return np.hypot(share * drawn_here, least)


def pool(samples: Sequence[PsfSample], on_step: StepHook = ignore_step) -> Pooled | None:
    """Solve all samples of one focal length together.

    Parameters
    ----------
    samples : sequence of PsfSample
        Those without a spectrum only help to begin.

    Returns
    -------
    Pooled or None
        None with fewer than `MIN_PLACES` patches that have a spectrum.
    """
    seen = [s for s in samples if s.spectrum is not None and s.weight > 0]
    places = _places(seen)
    if len(places) < MIN_PLACES:
        return None
    heads = [group.get("g", next(iter(group.values()))) for group in places]
    first = fit_wavefront(spread(samples, _FIRST))
    if first is None:
        return None
    widest = min((s.settings.aperture for s in seen if s.settings.aperture is not None), default=None)
    pitches = [s.pixel_pitch_um for s in seen if s.pixel_pitch_um is not None]
    first = replace(first, size=max(side_of_light(s.kernel) for s in heads))
    if widest is not None:
        pitch = float(np.median(pitches)) if pitches else USUAL_PITCH_UM
        first = replace(first, f_number=widest, log_q=_log_q(widest, pitch))
    begins = [first]
    centred = np.where(SYMMETRIC[: len(NAMES)], ABERRATIONS.with_kernels, 0.0)
    designs = np.stack([stopped(design(s.position, s.settings), first.stop(s.settings)) for s in heads])
    begins += [
        replace(first, terms=terms * (centred > 0), eye=ABERRATIONS.eye)
        for terms in starts(heads, designs, np.maximum(centred, 1e-3), math.exp(first.log_q), _STARTS)
    ]
    begins += _random_fronts(first, float(np.median([rms_width(s.kernel) for s in heads])))
    at = {id(head): group for head, group in zip(heads, places, strict=True)}
    wide, narrow = _by_aperture(heads, widest)
    chosen = [at[id(s)] for s in (*spread(wide, _FINE_PLACES), *spread(narrow, _NARROW_PLACES))]
    parts = [[at[id(s)] for s in spread(own, _FINE_PLACES)] for own in _pairs(wide)]
    views = [_view(group) for group in chosen]
    ends = [_sided(fit, heads, views) for fit in _searched(chosen, parts, begins, on_step)]
    best, tails = min(ends, key=lambda end: end[0].cost)
    trust: dict[str, list[float]] = {}
    for group, value in zip(chosen, best.trust, strict=True):
        trust.setdefault(next(iter(group.values())).photo, []).append(float(value))
    known = widest is not None and bool(pitches)
    return Pooled(best, tails, {photo: float(np.median(values)) for photo, values in trust.items()}, known)


def _searched(
    chosen: Sequence[Group], parts: Sequence[Sequence[Group]], begins: Sequence[Wavefront], on_step: StepHook
) -> list[PooledFit]:
    """Fit from many starts: all of them coarsely and centred, the best in green, the best of those in full.

    Where the pupil is round, a wavefront whose coma is negated has the same spectra as before. Only the
    cat's eye tells the two apart, so that both are tried. What many photos make likely in green can all lie
    in one minimum that is not the deepest of all colours together; what pairs of them do lies in others.
    """
    total = (1 + len(parts)) * (len(begins) * _COARSE_ROUNDS + 2 * _KEPT * _MEDIUM_ROUNDS)
    total += (_REFINED + len(parts) * _REFINED_OF_PAIR) * _FINE_ROUNDS
    done = 0
    fronts: list[Wavefront] = []
    for part in (chosen, *parts):
        green = [_view({"g": group["g"]}) for group in part if "g" in group]
        fits = []
        for begin in begins:
            fits.append(
                fit_spectra(green[:_COARSE_PLACES], begin, rounds=_COARSE_ROUNDS, symmetric=True, coarse=True)
            )
            on_step(done := done + _COARSE_ROUNDS, total)
        medium = []
        for fit in _different(fits)[:_KEPT]:
            for front in (fit.front, _mirrored(fit.front)):
                medium.append(fit_spectra(green[:_MEDIUM_PLACES], front, rounds=_MEDIUM_ROUNDS))
                on_step(done := done + _MEDIUM_ROUNDS, total)
        most = _REFINED if part is chosen else _REFINED_OF_PAIR
        fronts += [fit.front for fit in _different(medium)[:most]]
    fine, refined = [replace(_view(group), phases={}) for group in chosen], []
    for front in fronts:
        refined.append(fit_spectra(fine, front, rounds=_FINE_ROUNDS))
        on_step(done := done + _FINE_ROUNDS, total)
    on_step(total, total)
    return refined


def _sided(fit: PooledFit, heads: Sequence[PsfSample], views: Sequence[PatchView]) -> tuple[PooledFit, float]:
    """Return a fit on the side that tails and phases speak for, and their vote in standard deviations.

    Its cost is then with theirs, so that a lens whose coma is negated is found out as well. A vote of z
    standard deviations is a likelihood too: z^2 beside a cost of chi^2, for one side and against the other.
    """
    vote = tail_vote(_kernels(fit.front, heads), heads)
    own, turned = phase_costs(views, fit.front)
    costs = fit.cost + own - vote * abs(vote), fit.cost + turned + vote * abs(vote)
    apart = costs[1] - costs[0]
    both = math.copysign(math.sqrt(abs(apart) / 2.0), apart) if apart else 0.0
    front = fit.front if apart >= 0 else _negative(fit.front)
    return replace(fit, front=front, cost=min(costs)), both


def _pairs(samples: Sequence[PsfSample]) -> list[list[PsfSample]]:
    """Samples of the first photos two by two, of three photos or more, whatever their order."""
    photos = sorted({s.photo for s in samples})
    if len(photos) < _FEWEST_PAIRED:
        return []
    pairs = [set(photos[i : i + 2]) for i in range(0, len(photos) - 1, 2)][:_MOST_PAIRS]
    return [[s for s in samples if s.photo in pair] for pair in pairs]


def _by_aperture(
    samples: Sequence[PsfSample], widest: float | None
) -> tuple[Sequence[PsfSample], Sequence[PsfSample]]:
    """Samples of photos near the widest aperture, and those of photos stopped down.

    Stopped down, a lens hardly blurs: such patches tell what scenes look like, and little of the lens, so
    that they do not take the places of others. Where too few others are left, all count alike.
    """
    if widest is None:
        return samples, []
    narrow = [s for s in samples if (s.settings.aperture or widest) >= _STOPPED_DOWN * widest]
    if len(samples) - len(narrow) < MIN_PLACES:
        return samples, []
    closed = {id(s) for s in narrow}
    return [s for s in samples if id(s) not in closed], narrow


def _random_fronts(first: Wavefront, width: float) -> list[Wavefront]:
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


def _negative(front: Wavefront) -> Wavefront:
    """Return the wavefront of the kernels turned by 180 degrees."""
    return replace(front, terms=-front.terms)


def _mirrored(front: Wavefront) -> Wavefront:
    """Negate the coma."""
    terms = front.terms.copy()
    terms[_COMA] *= -1.0
    return replace(front, terms=terms)


def _log_q(aperture: float, pitch_um: float) -> float:
    """Logarithm of wavelength x f-number / pixel pitch, the width of diffraction, in green.

    It stays fixed: the pixels of a power spectrum follow it little, and kernels that were estimated one by
    one, to which it might be fitted, are too wide where blur is narrow.
    """
    return math.log(WAVELENGTH_NM["g"] / 1000.0 * aperture / pitch_um)


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


def _places(samples: Sequence[PsfSample]) -> list[dict[Channel, PsfSample]]:
    """Samples of one patch in its channels."""
    places: dict[tuple[str, float, float], dict[Channel, PsfSample]] = {}
    for sample in samples:
        key = (sample.photo, sample.position.r, sample.position.phi)
        places.setdefault(key, {})[sample.settings.channel] = sample
    return list(places.values())


def _view(group: dict[Channel, PsfSample]) -> PatchView:
    head = next(iter(group.values()))
    spectra = {c: group[c].spectrum for c in ("g", "r", "b") if c in group}
    scene = SceneView.of({c: s for c, s in spectra.items() if s is not None})
    phases = {
        c: s.cross for c, s in spectra.items() if s is not None and s.cross is not None and "g" in group
    }
    return PatchView(head.position, head.settings, head.photo, scene, phases)


def _kernels(front: Wavefront, samples: Sequence[PsfSample]) -> list[Kernel]:
    """Kernels that are compared with the tails of samples."""
    return [front.kernel(s.position, s.settings, _TAIL_SIDE) for s in samples]


def tail_vote(kernels: Sequence[Kernel], samples: Sequence[PsfSample]) -> float:
    """How much the patches' tails agree with those of kernels at their places, in standard deviations.

    Each patch votes by the cosine of the angle between the two: its strength is that of its scene's edges.
    """
    votes = []
    for kernel, sample in zip(kernels, samples, strict=True):
        if sample.spectrum is not None:
            own, seen = _third_moment(kernel), sample.spectrum.tail
            lengths = math.hypot(*own) * math.hypot(*seen)
            votes.append((own[0] * seen[0] + own[1] * seen[1]) / lengths if lengths > 0.0 else 0.0)
    total, scatter = float(np.sum(votes)), float(np.sqrt(np.sum(np.square(votes))))
    return total / scatter if scatter > 0 else 0.0


def _third_moment(kernel: Kernel) -> tuple[float, float]:
    """Vector sum k x |x|^2 over the cube of the width, (right, up)."""
    middle = kernel.shape[0] // 2
    row, col = np.mgrid[-middle : middle + 1, -middle : middle + 1]
    weight = kernel * (row**2 + col**2) / max(rms_width(kernel), 0.1) ** 3
    return float((weight * col).sum()), float(-(weight * row).sum())


def _vector(sample: PsfSample) -> tuple[float, float]:
    place: FieldPosition = sample.position
    return place.r * math.cos(place.phi), place.r * math.sin(place.phi)
