"""One wavefront for the whole lens: few numbers of aberration theory, fitted to all samples at once.

With the field vector h = (x, y) (right, up), r = |h|, and the terms of `pupil`, blur in pixels at the
widest aperture N0 is linear in the unknowns::

    |p|^4        a0 + a1 r^2                                        spherical
    p |p|^2      C h + k + C5 r^2 h                                 coma, with that of a decentred copy
    |p|^2        d0 + d.h + d2 r^2 + d4 r^4 + c1 t + c2 t^2         focus, tilt, field curvature, colour
    astigmatism  w h^2 + L h + K + w4 r^2 h^2  (complex)            two nodes, where the copy is decentred

Stopping down to N scales the blur of a term of degree n by (N0 / N)^(n - 1). Besides: q0, the width of
diffraction, and the cat's eye, a second circle that moves over the pupil with h. Least squares by
Levenberg-Marquardt with the exact derivatives of the kernels; each sample may move by a fraction of a
pixel. Starts come from the second and third moments of the samples, which are polynomials of the unknowns.

Sources: W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 7 and 8; K. P. Thompson,
"Description of the third-order optical aberrations of near-circular pupil optical systems without
symmetry", JOSA A 22, 2005.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.psf import PsfSample, as_kernel, centroid, resized
from lensmodel.regression.pupil import PupilGrid
from lensmodel.regression.starts import starts
from lensmodel.types import WAVELENGTH_NM, FieldPosition, Kernel, LensSettings

NAMES: Final = (
    *("spherical", "spherical r2"),
    *("coma", "uniform coma x", "uniform coma y", "coma r3"),
    *("focus", "tilt x", "tilt y", "field curvature", "field curvature r4", "colour 1", "colour 2"),
    *("astigmatism", "linear astigmatism 1", "linear astigmatism 2"),
    *("uniform astigmatism 1", "uniform astigmatism 2", "astigmatism r4"),
)
"""The linear unknowns, in pixels of blur at the widest aperture."""

_PRIOR_PX: Final = np.array(
    [4.0, 0.5, 4.0, 1.0, 1.0, 0.5, 4.0, 1.0, 1.0, 4.0, 0.5, 1.0, 1.0, 4.0, 1.0, 1.0, 1.0, 1.0, 0.5]
)
_SHAPE_PRIOR: Final = np.array([0.15, 0.3])  # of the cat's eye: radius and shift per unit of field
_USUAL_EYE: Final = (1.15, 0.25)
_USUAL_F, _USUAL_PITCH_UM = 2.8, 4.5
_NOISE = 0.1  # relative L2 that a good sample has against the best wavefront
_HUBER = 0.35
_LARGEST = 35
_COARSE, _FINE = 12, 36
_COARSE_ROUNDS, _FINE_ROUNDS = 8, 12
_STARTS = 4
_BLUR_PX = 1.0
_ENOUGH = 2e-3
_GUESSED = 0.1
_LEAST_HALF, _HELD_LIGHT = 5, 0.98
_MIN_SAMPLES = 12
_STEPS = 4
_CENTRED_PX = 1e-3


def design(position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
    """Blur of the first six terms of `pupil` at the widest aperture per unknown, shape (6, 19)."""
    x, y = position.r * math.cos(position.phi), position.r * math.sin(position.phi)
    r2, t = position.r**2, (WAVELENGTH_NM[settings.channel] - WAVELENGTH_NM["g"]) / 100.0
    xx, xy = x * x - y * y, 2.0 * x * y
    found = np.zeros((6, len(NAMES)))
    found[0, :2] = 1.0, r2
    found[1, 2:6] = x, 1.0, 0.0, r2 * x
    found[2, 2:6] = y, 0.0, 1.0, r2 * y
    found[3, 6:13] = 1.0, x, y, r2, r2 * r2, t, t * t
    found[4, 13:] = xx, x, -y, 1.0, 0.0, r2 * xx
    found[5, 13:] = xy, y, x, 0.0, 1.0, r2 * xy
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Wavefront:
    """The aberrations of one copy of a lens at one focal length.

    Parameters
    ----------
    terms : ndarray, shape (19,)
        Values of `NAMES`, pixels.
    log_q : float
        Logarithm of wavelength x f-number / pixel pitch at 540 nm and the widest aperture.
    eye : tuple of float
        Radius of the second circle of the pupil, and its shift per unit of field.
    f_number : float
        The widest aperture.
    size : int
        Odd side in pixels of the kernels that it was fitted to.
    error : float
        Median relative L2 of the samples against it.
    """

    terms: NDArray[np.float64]
    log_q: float
    eye: tuple[float, float]
    f_number: float
    size: int
    error: float = 1.0

    def kernel(self, position: FieldPosition, settings: LensSettings, size: int) -> Kernel:
        """Kernel of the image frame, centred, of odd side `size`; three wavelengths to a channel."""
        light = np.zeros((size, size))
        tilt = np.zeros(2)
        for shift, weight in ((0.0, 0.5), (-35.0, 0.25), (35.0, 0.25)):
            part, tilt = self._centred(position, settings, tilt, shift, size)
            light += weight * part
        return as_kernel(light)

    def stop(self, settings: LensSettings) -> float:
        """N0 / N; an unknown aperture counts as the widest."""
        return 1.0 if settings.aperture is None else min(self.f_number / settings.aperture, 1.0)

    def blur(self, position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
        """Blur of the terms of `pupil` in pixels, tilts zero, shape (8,)."""
        found = np.zeros(8)
        found[:6] = _stopped(design(position, settings), self.stop(settings)) @ self.terms
        return found

    def grid(self, settings: LensSettings, shift_nm: float = 0.0, size: int | None = None) -> PupilGrid:
        """Pupil and transform of a channel at an aperture."""
        colour = (WAVELENGTH_NM[settings.channel] + shift_nm) / WAVELENGTH_NM["g"]
        return _grid(round(math.exp(self.log_q) * colour / self.stop(settings), 4), size or self.size)

    def amplitude(
        self, grid: PupilGrid, position: FieldPosition, settings: LensSettings, eye: tuple[float, float]
    ) -> NDArray[np.float32]:
        """Transmission of the pupil at a place."""
        s = self.stop(settings)
        move = eye[1] * position.r / s
        return grid.amplitude(eye[0] / s, (move * math.cos(position.phi), move * math.sin(position.phi)))

    def _centred(
        self,
        position: FieldPosition,
        settings: LensSettings,
        tilt: NDArray[np.float64],
        shift_nm: float,
        size: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        grid = self.grid(settings, shift_nm, size)
        amplitude = self.amplitude(grid, position, settings, self.eye)
        g = self.blur(position, settings)
        rounds = _STEPS
        if not tilt.any():
            tilt = -np.array(grid.centre(g, amplitude))
        else:
            rounds = 0  # the outer wavelengths stay where the middle one puts them
        g[6:] = tilt
        light = grid.light(g, amplitude)
        for _ in range(rounds):
            row, col = centroid(light)
            if math.hypot(row, col) < _CENTRED_PX:
                break
            tilt = tilt + np.array([-col, row])
            g[6:] = tilt
            light = grid.light(g, amplitude)
        return light / light.sum(), tilt


@lru_cache(maxsize=24)
def _grid(q: float, size: int) -> PupilGrid:
    return PupilGrid.of(q, size)


def _stopped(blur: NDArray[np.float64], s: float) -> NDArray[np.float64]:
    return blur * np.array([s**3, s**2, s**2, s, s, s])[:, None]


def fit_wavefront(samples: Sequence[PsfSample], start: Wavefront | None = None) -> Wavefront | None:
    """Fit the wavefront of a lens to samples of one focal length.

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
    At most 36 samples spread over field and settings take part: the unknowns are few. One to three
    seconds; a quarter of that from an earlier fit.
    """
    kept = [s for s in samples if s.weight > 0]
    if len(kept) < _MIN_SAMPLES:
        return None
    apertures = [s.settings.aperture for s in kept if s.settings.aperture is not None]
    widest = min(apertures) if apertures else _USUAL_F
    pitches = [s.pixel_pitch_um for s in kept if s.pixel_pitch_um is not None]
    pitch = float(np.median(pitches)) if pitches else _USUAL_PITCH_UM
    kept.sort(key=_order)
    log_q = math.log(WAVELENGTH_NM["g"] / 1000.0 * widest / pitch)
    vague = 0.03 if apertures and pitches else (0.3 if apertures else 0.5)
    few, many = spread(kept, _COARSE), spread(kept, _FINE)
    size = max(_side_of_light(s.kernel) for s in many)
    if start is None:
        usual = Wavefront(np.zeros(len(NAMES)), log_q, _USUAL_EYE, widest, size)
        designs = np.stack([_stopped(design(s.position, s.settings), usual.stop(s.settings)) for s in many])
        coarse = _Problem(tuple(few), size, log_q, vague, _BLUR_PX)
        tried = [
            coarse.solve(replace(usual, terms=terms), _COARSE_ROUNDS)
            for terms in starts(many, designs, _PRIOR_PX, math.exp(log_q), _STARTS)
        ]
        begin = min(tried, key=lambda found: found[1])[0]
    else:
        begin = replace(start, size=size, f_number=widest)
    fine = _Problem(tuple(many), size, log_q, vague, 0.0)
    found, cost, errors = fine.solve(begin, _FINE_ROUNDS)
    if vague > _GUESSED:
        # the width of diffraction was a guess: blur alone leads to minima at either side of it
        for guess in (log_q - 0.5, log_q + 0.5):
            other, other_cost, other_errors = fine.solve(replace(begin, log_q=guess), _FINE_ROUNDS)
            if other_cost < cost:
                found, cost, errors = other, other_cost, other_errors
    return replace(found, error=float(np.median(errors)))


def _order(sample: PsfSample) -> tuple[float, float, float, str, str]:
    place = sample.position
    return place.r, place.phi, sample.settings.aperture or 0.0, sample.settings.channel, sample.photo


def _side_of_light(kernel: Kernel) -> int:
    """Odd side of the middle square that holds nearly all light."""
    middle = kernel.shape[0] // 2
    for half in range(min(_LEAST_HALF, middle), min(middle, _LARGEST // 2)):
        if kernel[middle - half : middle + half + 1, middle - half : middle + half + 1].sum() > _HELD_LIGHT:
            return 2 * half + 1
    return 2 * min(middle, _LARGEST // 2) + 1


def spread(samples: Sequence[PsfSample], count: int) -> list[PsfSample]:
    """Choose samples far from each other in place, colour and stops; the first is the best one."""
    if len(samples) <= count:
        return list(samples)
    where = np.array(
        [
            (
                s.position.r * math.cos(s.position.phi),
                s.position.r * math.sin(s.position.phi),
                0.004 * WAVELENGTH_NM[s.settings.channel],
                0.2 * (s.settings.stops or 0.0),
            )
            for s in samples
        ]
    )
    vote = np.array([s.weight for s in samples])
    chosen = [int(vote.argmax())]
    distance = ((where - where[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < count:
        chosen.append(int((distance * vote).argmax()))
        distance = np.minimum(distance, ((where - where[chosen[-1]]) ** 2).sum(axis=1))
    return [samples[i] for i in chosen]


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Least squares of a wavefront against samples, both blurred alike."""

    samples: tuple[PsfSample, ...]
    size: int
    log_q: float
    vague: float  # standard deviation of log q about `log_q`
    blur_px: float

    def solve(self, begin: Wavefront, rounds: int) -> tuple[Wavefront, float, NDArray[np.float64]]:
        """Levenberg-Marquardt; returns the wavefront, its cost and each sample's relative L2."""
        wanted = [self._soft(resized(s.kernel, self.size)) for s in self.samples]
        norms = np.array([np.linalg.norm(w) for w in wanted])
        votes = np.array([s.weight for s in self.samples])
        designs = [design(s.position, s.settings) for s in self.samples]
        now, tilts = begin, self._tilts(begin)
        damping = 1e-2
        state = self._linearised(now, tilts, designs, wanted, norms, votes)
        for _ in range(rounds):
            cost, normal, gradient, _, locals_ = state
            improved = False
            for _ in range(4):
                step = np.asarray(
                    -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=np.float64
                )
                moved = _moved(now, step)
                tilts_ = tilts + np.stack([-(a + b @ step) for a, b in locals_])
                after = self._linearised(moved, tilts_, designs, wanted, norms, votes)
                if after[0] < cost:
                    improved = True
                    break
                damping *= 8.0
            if not improved:
                break
            gain = cost - after[0]
            now, tilts, state, damping = moved, tilts_, after, damping / 5.0
            if gain < _ENOUGH * cost:
                break
        return now, state[0], state[3]

    def _soft(self, kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.blur_px == 0.0:
            return np.asarray(kernel)
        return np.asarray(
            ndimage.gaussian_filter(kernel, self.blur_px, axes=(-2, -1), mode="constant", truncate=3.0)
        )

    def _tilts(self, front: Wavefront) -> NDArray[np.float64]:
        found = []
        for s in self.samples:
            grid = front.grid(s.settings)
            amplitude = front.amplitude(grid, s.position, s.settings, front.eye)
            found.append(-np.array(grid.centre(front.blur(s.position, s.settings), amplitude)))
        return np.array(found)

    def _linearised(
        self,
        front: Wavefront,
        tilts: NDArray[np.float64],
        designs: Sequence[NDArray[np.float64]],
        wanted: Sequence[NDArray[np.float64]],
        norms: NDArray[np.float64],
        votes: NDArray[np.float64],
    ) -> tuple[
        float,
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    ]:
        """Cost, normal matrix, gradient, relative L2 of each sample, and how tilts follow a step."""
        count = len(NAMES) + 3  # log q and the cat's eye
        precision = np.concatenate([_PRIOR_PX**-2.0, [self.vague**-2.0], _SHAPE_PRIOR**-2.0])
        apart = np.concatenate([front.terms, [front.log_q - self.log_q], np.subtract(front.eye, _USUAL_EYE)])
        normal, gradient = np.diag(precision), precision * apart
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
            gradient += trust * (clean @ free)
            flat = errors[i] ** 2 if errors[i] <= _HUBER else _HUBER * (2 * errors[i] - _HUBER)
            cost += votes[i] * flat / _NOISE**2
            locals_.append((own, follows))
        assert normal.shape == (count, count)
        return cost, normal, gradient, errors, locals_

    def _columns(
        self,
        front: Wavefront,
        sample: PsfSample,
        tilt: NDArray[np.float64],
        linear: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Kernel of sum 1, its derivatives by the unknowns (count, k^2) and by the tilts (2, k^2)."""
        settings, position = sample.settings, sample.position
        grid = front.grid(settings)
        radius, shift = front.eye
        amplitude = front.amplitude(grid, position, settings, front.eye)
        wider = front.amplitude(grid, position, settings, (radius + 0.02, shift)) - amplitude
        further = front.amplitude(grid, position, settings, (radius, shift + 0.02)) - amplitude
        g = front.blur(position, settings)
        g[6:] = tilt
        light, found = grid.with_derivatives(g, amplitude, (wider / 0.02, further / 0.02))
        softer = replace(front, log_q=front.log_q + 0.05).grid(settings)
        broad = softer.light(g, front.amplitude(softer, position, settings, front.eye))
        by_q = (broad / broad.sum() * light.sum() - light) / 0.05
        stack = self._soft(np.concatenate([found, by_q[None], light[None]]))
        flat = stack.reshape(len(stack), -1)
        total = light.sum()
        sums = np.concatenate([found.sum(axis=(1, 2)), [by_q.sum()]])
        kernel = flat[-1] / total
        normalised = flat[:-1] / total - np.outer(sums / total, kernel)
        terms = _stopped(linear, front.stop(settings)).T @ normalised[:6]
        return kernel, np.concatenate([terms, normalised[[10, 8, 9]]]), normalised[6:8]


def _moved(front: Wavefront, step: NDArray[np.float64]) -> Wavefront:
    n = len(NAMES)
    q = float(np.clip(front.log_q + step[n], math.log(0.1), math.log(12.0)))
    eye = (max(front.eye[0] + float(step[n + 1]), 0.4), front.eye[1] + float(step[n + 2]))
    return replace(front, terms=front.terms + step[:n], log_q=q, eye=eye)
