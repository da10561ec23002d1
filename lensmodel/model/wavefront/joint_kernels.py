"""The kernels of all samples of a lens, solved together from their spectra.

A wavefront is fitted to the spectra of all patches (`fit`), beginning with fits to the samples' own kernels
and to their moments; the side of the tails is decided by the patches' vote (`PatchSpectrum.tail`) and, where
a photo's mosaic is known, by the phases of red and blue against green.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.psf import PsfSample, distance, rms_width
from lensmodel.core.types import WAVELENGTH_NM, FieldPosition, Kernel, StepHook, ignore_step
from lensmodel.model.wavefront.from_kernels import (
    USUAL_PITCH_UM,
    fit_wavefront,
    side_of_light,
    spread_samples,
)
from lensmodel.model.wavefront.from_spectra import (
    SYMMETRIC,
    PatchView,
    PooledFit,
    fit_spectra,
    open_eye,
    phase_costs,
)
from lensmodel.model.wavefront.search import (
    MOST_PATCHES,
    Group,
    held_out,
    pairs,
    random_fronts,
    search,
    view,
)
from lensmodel.model.wavefront.starts import starts
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.wavefront import NAMES, Wavefront, design, stopped

MIN_PLACES: Final = 8
"""Fewer patches with a spectrum are not solved together (chosen: a third of those of a photo)."""

_NARROW_PLACES, _STOPPED_DOWN = 24, 2.0
"""Patches at most of photos stopped down, and the multiple of the widest f-number from which on they are (two
stops). With all of them, five such photos take back what one adds."""
_STARTS = 6  # by moments, for the search: each further one is less likely and costs as much (chosen)
_FIRST = 16  # samples of the first fit to kernels: it only gives a place to begin (chosen)
_MOST_SINGLE = 2  # photos that are fitted alone (chosen: each costs as much as a whole fit of one)
_JUDGED = 4  # minima that are judged by patches left out (chosen: each costs some seconds)
_JUDGEMENT = 15  # steps of a fit that judging one is worth, for the progress
_LAST_ROUNDS = 10
"""Steps of the fit with phases at most: it begins where it ended without them, near its end (chosen)."""
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
        few = spread_samples(samples, _ERROR_PLACES)
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


def pool_samples(
    samples: Sequence[PsfSample], on_step: StepHook = ignore_step, known: Sequence[Wavefront] = ()
) -> Pooled | None:
    """Solve all samples of one focal length together.

    Parameters
    ----------
    samples : sequence of PsfSample
        Those without a spectrum only help to begin.
    known : sequence of Wavefront
        What earlier fits of the lens, to fewer samples, came to; without any, single photos are fitted first,
        and the steps of each begin anew.

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
    first = fit_wavefront(spread_samples(samples, _FIRST))
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
    begins += random_fronts(first, float(np.median([rms_width(s.kernel) for s in heads])))
    at = {id(head): group for head, group in zip(heads, places, strict=True)}
    wide, narrow = _by_aperture(heads, widest)
    chosen = [
        at[id(s)] for s in (*spread_samples(wide, MOST_PATCHES), *spread_samples(narrow, _NARROW_PLACES))
    ]
    parts = [[at[id(s)] for s in spread_samples(own, MOST_PATCHES)] for own in pairs(wide)]
    views = [view(group) for group in chosen]
    known = known or _of_single_photos(samples, on_step)
    former = [replace(first, terms=front.terms, eye=front.eye) for front in known]
    searched = 0

    def on_search(done: int, total: int) -> None:
        nonlocal searched
        searched = total
        on_step(done, total + _JUDGED * _JUDGEMENT)

    sides = [_sided(fit, heads, views) for fit in search(chosen, parts, begins, former, on_search)]
    sides.sort(key=lambda side: side[0].cost)
    best, tails, least = *sides[0], math.inf
    for number, side in enumerate(sides[:_JUDGED]):
        fit, votes = _with_phases(*side, heads, views)
        cost = fit.cost + held_out(chosen, fit.front)
        if cost < least:
            best, tails, least = fit, votes, cost
        on_step(searched + (number + 1) * _JUDGEMENT, searched + _JUDGED * _JUDGEMENT)
    on_step(searched + _JUDGED * _JUDGEMENT, searched + _JUDGED * _JUDGEMENT)
    trust: dict[str, list[float]] = {}
    for group, value in zip(chosen, best.trust, strict=True):
        trust.setdefault(next(iter(group.values())).photo, []).append(float(value))
    sure = widest is not None and bool(pitches)
    return Pooled(best, tails, {photo: float(np.median(values)) for photo, values in trust.items()}, sure)


def _of_single_photos(samples: Sequence[PsfSample], on_step: StepHook) -> list[Wavefront]:
    """What the first photos say of the lens alone; nothing of a single photo, which is all there is.

    An earlier version of the fit, where there is one, stands in for them: it had them among its beginnings.
    """
    photos = sorted({s.photo for s in samples})
    first = photos[:_MOST_SINGLE] if len(photos) > 1 else []
    alone = [pool_samples([s for s in samples if s.photo == photo], on_step) for photo in first]
    return [one.front for one in alone if one is not None]


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


def _with_phases(
    fit: PooledFit, votes: float, heads: Sequence[PsfSample], views: Sequence[PatchView]
) -> tuple[PooledFit, float]:
    """Return a fit that is on its side with phases as observations, where patches have them, and its vote."""
    if not any(patch.phases for patch in views):
        return fit, votes
    fit = fit_spectra(views, fit.front, rounds=_LAST_ROUNDS)
    vote = tail_vote(_kernels(fit.front, heads), heads)
    return replace(fit, cost=fit.cost - vote * abs(vote)), votes


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


def _negative(front: Wavefront) -> Wavefront:
    """Return the wavefront of the kernels turned by 180 degrees."""
    return replace(front, terms=-front.terms)


def _log_q(aperture: float, pitch_um: float) -> float:
    """Logarithm of wavelength x f-number / pixel pitch, the width of diffraction, in green.

    It stays fixed: the pixels of a power spectrum follow it little, and kernels that were estimated one by
    one, to which it might be fitted, are too wide where blur is narrow.
    """
    return math.log(WAVELENGTH_NM["g"] / 1000.0 * aperture / pitch_um)


def _places(samples: Sequence[PsfSample]) -> list[Group]:
    """Samples of one patch in its channels."""
    places: dict[tuple[str, float, float], Group] = {}
    for sample in samples:
        key = (sample.photo, sample.position.r, sample.position.phi)
        places.setdefault(key, {})[sample.settings.channel] = sample
    return list(places.values())


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
