"""Fitting the wavefront of a lens: from the moments of its samples to a fit of their kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM, Kernel
from lensmodel.model.wavefront.least_squares import WavefrontProblem
from lensmodel.model.wavefront.starts import starts
from lensmodel.optics.aberration_prior import ABERRATIONS
from lensmodel.optics.wavefront import NAMES, Wavefront, design, stopped

_USUAL_F = 2.8  # widest f-number where no sample says (chosen: between primes and zooms)
USUAL_PITCH_UM = 4.5
"""Of sensors whose pixel pitch nobody knows (chosen: 42 megapixels on 36 x 24 mm)."""

_LARGEST = 55  # pixels: the largest side that estimators give
# Samples of the search and of the fit: 36 kernels over-determine 22 unknowns (chosen)
_COARSE, _FINE = 12, 36
_COARSE_ROUNDS, _FINE_ROUNDS = 8, 12  # steps at most: only the last fit has to end (chosen)
_STARTS, _REFINED = 4, 2
"""Beginnings by moments, and those of them that are fitted in full: signs of the odd terms leave a few
minima; each costs a fit (chosen)."""
_REFINING_ROUNDS = 6  # steps at most of a fit that begins near its end: half of a whole one (chosen)
_KNOWN, _PITCH_GUESSED, _APERTURE_GUESSED = 0.03, 0.3, 0.5
"""Standard deviation of the logarithm of diffraction's width q: with aperture and pitch known, without the
pitch, and without both (chosen: f-numbers are rounded to 3 percent, most pitches lie within a third)."""
_BLUR_PX = 1.0  # of kernels in the search: minima that differ by less in their kernels become one (chosen)
_LEAST_HALF = 5  # pixels: half the side of the smallest kernel that is fitted (chosen: 11 x 11 hold a core)
_HELD_LIGHT = 0.98
"""Share that the fitted square holds: with more, noise of estimates counts as wings, with less, wings are cut
(chosen)."""
MIN_SAMPLES = 12
"""Fewer samples make no wavefront (chosen: half the patches of one photo)."""

ONE_FOCAL_LENGTH = 0.25
"""Octaves within which focal lengths are one (chosen: over a fifth of it lenses hardly change)."""


def fit_wavefront(samples: Sequence[PsfSample], start: Wavefront | None = None) -> Wavefront | None:
    """Fit the wavefront of a lens to samples, of several focal lengths if it is a zoom.

    Parameters
    ----------
    samples : sequence of PsfSample
        Weights count.
    start : Wavefront, optional
        An earlier fit to begin with instead of searching.

    Returns
    -------
    Wavefront or None
        None with fewer than twelve samples.

    Notes
    -----
    At most 36 samples spread over field and settings take part, twice as many of a zoom: the unknowns are
    few. Focal lengths within a quarter octave are one.
    """
    kept = [s for s in samples if s.weight > 0]
    if len(kept) < MIN_SAMPLES:
        return None
    apertures = [s.settings.aperture for s in kept if s.settings.aperture is not None]
    widest = min(apertures) if apertures else _USUAL_F
    pitches = [s.pixel_pitch_um for s in kept if s.pixel_pitch_um is not None]
    pitch = float(np.median(pitches)) if pitches else USUAL_PITCH_UM
    kept.sort(key=_order)
    log_q = math.log(WAVELENGTH_NM["g"] / 1000.0 * widest / pitch)
    vague = _KNOWN if apertures and pitches else (_PITCH_GUESSED if apertures else _APERTURE_GUESSED)
    zoom = focal_range(kept) > ONE_FOCAL_LENGTH
    few, many = spread_samples(kept, _COARSE * (1 + zoom)), spread_samples(kept, _FINE * (1 + zoom))
    size = max(side_of_light(s.kernel) for s in many)
    begins = [start] if start is not None else []
    if start is None:
        usual = Wavefront(np.zeros(len(NAMES)), log_q, ABERRATIONS.eye, widest, size)
        if zoom:
            known = [math.log2(s.settings.focal_mm) for s in kept if s.settings.focal_mm is not None]
            usual = replace(usual, slopes=np.zeros(len(NAMES)), focal_octaves=float(np.median(known)))
        coarse = WavefrontProblem(tuple(few), size, log_q, vague, _BLUR_PX)
        tried = [coarse.solve(front, _COARSE_ROUNDS) for front in _starts(many, usual)]
        # the best fit of few blurred samples need not lead to the best of all sharp ones
        begins = [front for front, _, _ in sorted(tried, key=lambda fit: fit[1])[:_REFINED]]
    fine = WavefrontProblem(tuple(many), size, log_q, vague, 0.0)
    fitted = [fine.solve(replace(begin, size=size, f_number=widest), _FINE_ROUNDS) for begin in begins]
    likeliest, cost, errors = min(fitted, key=lambda fit: fit[1])
    if vague > _KNOWN:
        # the width of diffraction was a guess: blur alone leads to minima at either side of it
        for guess in (log_q - 0.5, log_q + 0.5):
            other, other_cost, other_errors = fine.solve(replace(likeliest, log_q=guess), _FINE_ROUNDS)
            if other_cost < cost:
                likeliest, cost, errors = other, other_cost, other_errors
    if zoom:
        # turned by 180 degrees at one end only, spots without coma stay as they are
        other, other_cost, other_errors = fine.solve(_turned_at_one_end(likeliest, kept), _FINE_ROUNDS)
        if other_cost < cost:
            likeliest, errors = other, other_errors
    return replace(likeliest, error=float(np.median(errors)))


def refined(front: Wavefront, samples: Sequence[PsfSample]) -> Wavefront:
    """A wavefront after some steps towards samples, of which there may be fewer than it was fitted to."""
    many = spread_samples(samples, _FINE * (1 + (front.slopes is not None)))
    problem = WavefrontProblem(tuple(many), front.size, front.log_q, _KNOWN, 0.0)
    return problem.solve(front, _REFINING_ROUNDS)[0]


def focal_range(samples: Sequence[PsfSample]) -> float:
    """Octaves between the shortest and the longest focal length that samples name."""
    known = [s.settings.focal_mm for s in samples if s.settings.focal_mm is not None]
    return math.log2(max(known) / min(known)) if known else 0.0


def side_of_light(kernel: Kernel) -> int:
    """Odd side of the middle square that holds nearly all light."""
    middle = kernel.shape[0] // 2
    for half in range(min(_LEAST_HALF, middle), min(middle, _LARGEST // 2)):
        if kernel[middle - half : middle + half + 1, middle - half : middle + half + 1].sum() > _HELD_LIGHT:
            return 2 * half + 1
    return 2 * min(middle, _LARGEST // 2) + 1


def _starts(samples: Sequence[PsfSample], usual: Wavefront) -> list[Wavefront]:
    """Wavefronts whose ray spots have the moments of samples."""
    designs = np.stack([stopped(design(s.position, s.settings), usual.stop(s.settings)) for s in samples])
    expected = ABERRATIONS.with_kernels
    q, count = math.exp(usual.log_q), len(NAMES)
    if usual.slopes is None:
        return [replace(usual, terms=terms) for terms in starts(samples, designs, expected, q, _STARTS)]
    octaves = np.array([usual.octaves(s.settings) for s in samples])
    both = np.concatenate([designs, designs * octaves[:, None, None]], axis=2)
    vectors = starts(samples, both, np.concatenate([expected, ABERRATIONS.slopes]), q, 2 * _STARTS)
    return [replace(usual, terms=terms[:count], slopes=terms[count:]) for terms in vectors]


def _turned_at_one_end(front: Wavefront, samples: Sequence[PsfSample]) -> Wavefront:
    """Negate the terms at the longest focal length, those at the shortest stay."""
    assert front.slopes is not None
    octaves = [front.octaves(s.settings) for s in samples]
    short, long = min(octaves), max(octaves)
    first, last = front.terms + front.slopes * short, front.terms + front.slopes * long
    slopes = (-last - first) / (long - short)
    return replace(front, terms=first - slopes * short, slopes=slopes)


def _order(sample: PsfSample) -> tuple[float, float, float, str, str]:
    place = sample.position
    return place.r, place.phi, sample.settings.aperture or 0.0, sample.settings.channel, sample.photo


def spread_samples(samples: Sequence[PsfSample], count: int) -> list[PsfSample]:
    """Choose samples far from each other in place and settings; the first is the best one.

    Where every place is taken, those of the larger votes follow, and of equal votes by photo.
    """
    if len(samples) <= count:
        return list(samples)
    where = np.array(
        [
            (
                s.position.r * math.cos(s.position.phi),
                s.position.r * math.sin(s.position.phi),
                0.004 * WAVELENGTH_NM[s.settings.channel],
                0.2 * (s.settings.stops or 0.0),
                0.4 * math.log2(s.settings.focal_mm or 1.0),
            )
            for s in samples
        ]
    )
    vote = np.array([s.weight for s in samples])
    chosen = [int(vote.argmax())]
    distance = ((where - where[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < count and (distance * vote).max() > 0:
        chosen.append(int((distance * vote).argmax()))
        distance = np.minimum(distance, ((where - where[chosen[-1]]) ** 2).sum(axis=1))
    left = [i for i in range(len(samples)) if i not in chosen]
    left.sort(key=lambda i: (-vote[i], samples[i].photo))
    return [samples[i] for i in (*chosen, *left)][:count]
