"""What all ways of measuring share: `Measurer`, windows of a photo, and the PSF of one (`solve`).

It is found by weighted least squares against the sharp picture that the window shows. For the pixels p that
the sensor measured in a window,

    y(p) = sum_t k(t) x(p - t) + sum_j c_j q_j(p) + n(p)          var n(p) = s(p)²

so that only the latent picture x must be known everywhere, and a mosaic needs no demosaicing. The q_j, terms
of a quadratic, are slow changes of light over the blurred picture; the c_j are eliminated (R. Frisch and F.
Waugh, Econometrica 1, 1933). In a stack of windows, hardly wider than the kernel, a quadratic would take its
wings as well: there, a constant. Every value of the kernel has a normal prior of mean 0, whose width falls
with the distance d to the middle as the light of a lens does,  t(d) = T / (1 + (d / D)²).  Minimal is

    sum_p (y - k * x - c)² / (q s²) + sum_t k(t)² / t(d)²

over all k >= 0 whose sum is that of the minimum over all k, where q is the mean of the squared residuals over
what the noise explains, below 1 only where that is overstated, as it is of a scene without a flat place.
Without the sum, k >= 0 would cut off one half of the noise and keep the other: hundreds of values around a
small core then add up to a halo that is not there. Its expected error e is
e² = trace (X'X / q + diag(1 / t²))^-1 / |k|².

A kernel that changes within the window (`varying`) is linear in the place, k + u k_u + v k_v with u and v
from -1 to 1 over its rows and columns; k_u and k_v are eliminated too. It is found at the phase between
pixels that fits best: with a peak as narrow as a pixel it is not negative on one grid of pixels alone; moved
by half a pixel, it rings, and k >= 0 cuts one half of that off. So X S(d) k is compared with y, where S(d)
moves a kernel by d pixels (by sinc, exact for a picture without frequencies beyond the pixels'), and d
minimises the misfit. A weak prior keeps the centre of mass of a smooth kernel in the middle.

Sources: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4 (known sharp
picture, non-negative least squares); M. Delbracio et al., IJCV 96, 2012, section 3.
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final, NamedTuple, TypeAlias

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.numerics import fista, on_simplex
from lensmodel.core.psf import MEASURED, PsfSample, as_kernel, centroid
from lensmodel.core.types import CHANNELS, Channel, Kernel, LensSettings, NoiseModel, StepHook, ignore_step
from lensmodel.photo import LinearPhoto


class Found(NamedTuple):
    """A kernel, and the window of the photo that tells of it."""

    kernel: Kernel
    error: float  # expected relative L2, as far as the window shows it
    middle: Sequence[float] | NDArray[np.floating]  # pixel (row, col)


Prepared: TypeAlias = tuple[Sequence[Any], Callable[[Any, Channel], Found]]


class Measurer(ABC):
    """One way to measure the PSF of a lens on photos made for it."""

    name: ClassVar[str]
    photos: ClassVar[int] = 1
    """How many photos one measurement takes."""
    floor: ClassVar[float]
    """Error that no window shows of itself."""
    most: ClassVar[float] = math.inf
    """Expected error from which on a kernel helps no model: blind ones are as good."""
    shows: ClassVar[str]
    """What the photos are to show."""

    def measure(
        self,
        photos: Sequence[LinearPhoto],
        *,
        size: int = 31,
        channels: Sequence[Channel] = CHANNELS,
        settings: LensSettings | None = None,
        photo_id: str = "",
        on_step: StepHook = ignore_step,
    ) -> list[PsfSample]:
        """Measure the PSF wherever the photos, as many as `photos` says, show it: samples for a `LensModel`.

        The first, wide open where there are two, is the one whose PSF is measured, at `settings`, else those
        that it says itself; kernels have an odd side of `size` pixels. The estimator is called
        `measured-NAME/VERSION`. `on_step` is called after each place, and now and then before the first one,
        with nothing done of 1.
        """
        if len(photos) != self.photos:
            raise InvalidInputError(f"measuring by {self.name} takes {self.photos} photos, got {len(photos)}")
        if size < 3 or size % 2 == 0:
            raise InvalidInputError(f"kernels have an odd side of 3 pixels or more, got {size}")
        first, samples = photos[0], list[PsfSample]()
        settings = settings or first.info.metadata.settings()
        first.info.metadata.require_aperture(settings)
        first.info.require_known_turn()
        places, psf_in = self._prepare(photos, size, on_step)
        for done, place in enumerate(places, start=1):
            for channel in channels:
                with contextlib.suppress(LensModelError):
                    kernel, own, (row, col) = psf_in(place, channel)
                    if not (error := math.hypot(own, self.floor)) < self.most:  # not known, or too large
                        continue
                    sample = PsfSample(
                        kernel,
                        first.frame.position(row, col),
                        settings.with_channel(channel),
                        photo=photo_id,
                        pixel_pitch_um=first.info.metadata.pixel_pitch_um,
                        estimator=f"{MEASURED}{self.name}/1",
                        error=error,
                        half_diagonal_px=first.frame.half_diagonal,
                    )
                    samples.append(sample)
            on_step(done, len(places))
        if not samples:
            raise NotEnoughEvidenceError(
                f"nothing in the photo gives a PSF by {self.name}; photograph {self.shows}, in focus, at low "
                "noise and unclipped"
            )
        return samples

    @abstractmethod
    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find the places that photos show, and what measures one of them in a colour or raises."""


# --- the kernel of a window ------------------------------------------------------------------------


def window_terms(side: int, margin: int = 0) -> NDArray[np.float64]:
    """Terms 1, r, c, r², rc, c² of a smooth change of light, last axis; r and c are -1 to 1 in a window."""
    t = np.arange(-margin, side + margin) * 2.0 / (side - 1) - 1.0
    r, c = np.meshgrid(t, t, indexing="ij")
    return np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)


PEAK: Final = 0.5  # T: so much light has the middle of the sharpest kernel, a pixel and some diffraction
REACH: Final = 2.5  # D in pixels: light 10 px away is expected below 3 percent, ten times that of wide halos
# Width of the prior of k_u and k_v over that of k (chosen: at three times as much nothing changed; measured
# once, no command repeats it)
CHANGE: Final = 0.3
CENTRED_PX: Final = 0.3  # expected distance of the centre of mass from the middle: that of the match (chosen)
_ROWS: Final = 2048  # of the design matrix at once: a whole window would take hundreds of megabytes (chosen)
_STEPS: Final = 300  # of the projected gradient: more only cost time (chosen)
_STILL: Final = 1e-7  # of the light: no value moves by more
_MOST_PX: Final = 1.0  # largest phase along an axis: a whole pixel is another match (chosen)
_FIRST_PX, _LAST_PX = 0.25, 0.03  # steps of the search for the phase, coarse to fine (chosen)
_SEARCHED: Final = 100  # steps from one phase to the next: only the order of their misfits counts (chosen)
_NO_KERNEL: Final = "no kernel explains this window; the latent picture does not match it"

_Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A kernel and how well it explains its window."""

    kernel: Kernel  # (k, k), not centred
    # sum of the kernel before it was normalised: what the latent picture must be multiplied with
    light: float
    shift: tuple[float, float]  # its centre of mass, (row, col) pixels from the middle
    error: float  # expected relative L2


def solve(
    observed: NDArray[np.floating],
    latent: NDArray[np.floating],
    measured: NDArray[np.bool_],
    variance: NDArray[np.floating],
    size: int,
    *,
    varying: bool = False,
) -> Solved:
    """Find the kernel of odd side `size` that makes the latent picture the observed one.

    Windows are `(side, side)`, or `(n, side, side)` to share a kernel; the latent picture has a margin of
    half a kernel. A kernel that may be `varying` needs no centring.
    """
    n, count = size * size, int(measured.sum())
    if count < n:
        raise NotEnoughEvidenceError(f"{count} pixels count, {n} are needed for a kernel of side {size}")
    weight = np.where(measured, 1.0 / np.maximum(variance, 1e-12), 0.0)
    whole = _gram(observed, latent, weight, size, varying=varying)
    t = np.arange(size) - size // 2
    prior = ((1.0 + (t[:, None] ** 2 + t**2) / REACH**2) / PEAK).ravel() ** 2  # 1 / t(d)²
    k, misfit, moved = np.zeros(n), 1.0, np.zeros(2)
    gram = _of_kernel(whole, misfit, prior)
    for _ in range(2):  # the second time with the residuals of the first
        k = _bounded(gram[:n, :n] + np.diag(prior), gram[:n, n], k)
        rest = np.append(-k, 1.0)
        left = misfit * float(rest @ gram @ rest)
        # below 1 only where all n values of a kernel cannot have taken off so much: the noise was overstated
        misfit = max(left / count, min(left / max(count - n, 1), 1.0))
        gram = _of_kernel(whole, misfit, prior)
    if varying:
        k, moved = _on_its_grid(gram, prior, k, size)
    try:
        kernel = as_kernel(k.reshape(size, size))
        posterior = scipy.linalg.inv(gram[:n, :n] + np.diag(prior), check_finite=False)
    except (InvalidInputError, scipy.linalg.LinAlgError) as error:
        raise NotEnoughEvidenceError(_NO_KERNEL) from error
    row, col = np.add(centroid(kernel), moved)
    # root of the posterior variance of all values over the norm of the kernel; 1 is the worst
    spread = float(np.maximum(np.diag(posterior), 0.0).sum())
    relative = min(math.sqrt(spread / float(k @ k)), 1.0)
    return Solved(kernel, float(k.sum()), (float(row), float(col)), relative)


def _gram(
    observed: NDArray[np.floating], latent: NDArray[np.floating], weight: _Floats, size: int, *, varying: bool
) -> _Floats:
    """Weighted products of all columns: those of k, or of k, k_u and k_v, less slow changes of light, and y.

    With v = (-k, 1) the sum of squared residuals is  v' G v,  so that G holds the normal equations.
    """
    # a constant is one of the slow changes; without it single precision holds the detail
    latent = np.asarray(latent - latent.mean(), dtype=np.float32)
    observed = np.asarray(observed - observed[weight > 0].mean(), dtype=np.float32)
    views = sliding_window_view(latent, (size, size), axis=(-2, -1))[..., ::-1, ::-1]
    terms = window_terms(weight.shape[-1]).astype(np.float32)
    pixels = np.nonzero(weight)
    kept = (3 if varying else 1) * size * size + 1
    of_light = terms.shape[-1] if weight.ndim == 2 else 1
    gram = np.zeros((kept + of_light,) * 2)
    for first in range(0, pixels[0].size, _ROWS):
        part = tuple(axis[first : first + _ROWS] for axis in pixels)
        x, slow = views[part].reshape(-1, size * size), terms[part[-2:]]
        moving = [x * slow[:, 1:2], x * slow[:, 2:3]] if varying else []
        columns = np.concatenate([x, *moving, observed[part][:, None], slow[:, :of_light]], axis=1)
        columns *= np.sqrt(weight[part]).astype(np.float32)[:, None]
        gram += columns.T @ columns
    light, across = gram[kept:, kept:], gram[kept:, :kept]
    # few pixels may not tell all terms apart
    return gram[:kept, :kept] - across.T @ (np.linalg.pinv(light, hermitian=True) @ across)


def _of_kernel(gram: _Floats, misfit: float, prior: _Floats) -> _Floats:
    """Products over the misfit, of k and y alone: k_u and k_v, if they are there, eliminated (Schur)."""
    n, gram = len(prior), gram / misfit
    if len(gram) == n + 1:
        return gram
    kept = np.append(np.arange(n), len(gram) - 1)
    inner = gram[n:-1, n:-1] + np.diag(np.tile(prior / CHANGE**2, 2))
    across = gram[n:-1, kept]
    return gram[np.ix_(kept, kept)] - across.T @ scipy.linalg.solve(inner, across, assume_a="sym")


def _bounded(a: _Floats, b: _Floats, start: _Floats) -> _Floats:
    """Minimise k'Ak/2 - b'k over k >= 0 of the free minimum's sum."""
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    lift = max(1e-6 * largest - float(eigenvalues[0]), 0.0)  # single precision may leave it indefinite
    a = a + lift * np.eye(len(b))
    light = float(scipy.linalg.solve(a, b, assume_a="pos").sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError(_NO_KERNEL)
    return _of_sum(a, b, start, light, largest + lift, _STEPS)


def _of_sum(a: _Floats, b: _Floats, start: _Floats, light: float, largest: float, steps: int) -> _Floats:
    """Minimise k'Ak/2 - b'k over k >= 0 of a sum; `largest` bounds the eigenvalues of A."""
    project, still = partial(on_simplex, total=light), _STILL * light
    return fista(lambda k: a @ k - b, start, 1.0 / largest, project, steps=steps, still=still)


def _on_its_grid(gram: _Floats, prior: _Floats, start: _Floats, size: int) -> tuple[_Floats, _Floats]:
    """Kernel and phase (row, col) in pixels at which k >= 0 explains the window best."""
    n, t, k, light = len(prior), np.arange(size), start, float(start.sum())
    # moving a kernel by sinc lengthens none; the prior is the same for all
    last = {"subset_by_index": (n - 1, n - 1)}
    largest = 1.02 * float(scipy.linalg.eigvalsh(gram[:n, :n] + np.diag(prior), **last)[0])

    def cost(phase: _Floats) -> float:
        """Misfit of the best kernel at a phase, k'S'ASk - 2 b'Sk and the priors."""
        nonlocal k
        down, across = (np.sinc(t[:, None] - t - by) for by in phase)

        def left(m: _Floats) -> _Floats:  # S'm, axis by axis
            rows = (down.T @ m.reshape(size, -1)).reshape(size, size, -1)
            return np.asarray(np.matmul(across.T, rows).reshape(n, -1))

        a, b = left(left(gram[:n, :n]).T), left(gram[:n, n])[:, 0]
        k = _of_sum(a + np.diag(prior), b, k, light, largest, _SEARCHED)
        off = centroid(as_kernel(k.reshape(size, size)))
        misfit = float(k @ a @ k) - 2.0 * float(b @ k) + float(prior @ (k * k))
        return misfit + (off[0] ** 2 + off[1] ** 2) / CENTRED_PX**2

    steps = {"initial_simplex": [(0.0, 0.0), (_FIRST_PX, 0.0), (0.0, _FIRST_PX)], "xatol": _LAST_PX}
    best = scipy.optimize.minimize(
        cost, (0.0, 0.0), method="Nelder-Mead", bounds=[(-_MOST_PX, _MOST_PX)] * 2,
        options={**steps, "fatol": np.inf},
    )  # fmt: skip
    cost(best.x)
    return k, best.x


# `latent(shift, margin)`: the sharp picture of a window, moved down and right by `shift` pixels
Latent = Callable[[tuple[float, float], int], NDArray[np.floating]]
SMALL: Final = 15  # side of the kernel by which the middle is found: its wings hardly move it
NEAR_CLIP: Final = 0.97  # of the clipping level, above which no pixel is believed: sensors bend before it
_MOST_SHIFT: Final = 3.0  # pixels; beyond, the small kernel is cut off


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A square window of one colour of a photo."""

    corner: tuple[int, int]  # top left pixel, (row, col)
    light: NDArray[np.float64]  # (side, side)
    measured: NDArray[np.bool_]  # which pixels the sensor measured in this colour, unclipped
    noise: NoiseModel  # of the pixels that were measured

    @classmethod
    def of(cls, photo: LinearPhoto, channel: Channel, corner: tuple[int, int], side: int) -> Window:
        """Cut it out of a photo."""
        (row, col), index = corner, CHANNELS.index(channel)
        light = photo.planes[index, row : row + side, col : col + side].astype(np.float64)
        measured = np.asarray(light < np.float32(NEAR_CLIP * photo.clip[index]))
        if photo.cfa is not None:
            rows, cols = (row + np.arange(side)) % 2, (col + np.arange(side)) % 2
            measured &= np.asarray(photo.cfa)[rows[:, None], cols[None, :]] == index
        return cls(corner, light, measured, (photo.sensor_noise or photo.noise)[index])

    @property
    def middle(self) -> NDArray[np.float64]:
        """Pixel (row, col) of the photo."""
        return np.add(self.corner, (len(self.light) - 1) / 2.0)

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of the noise, its mean: by its own, a pixel dark by chance would count for more."""
        own = self.noise.shot * np.maximum(self.light, 0.0) + self.noise.read
        return np.full(own.shape, float(own[self.measured].mean()) if self.measured.any() else 1.0)

    def solved(self, latent: NDArray[np.floating], size: int, *, varying: bool = False) -> Solved:
        """Find the kernel behind which a latent picture is this window."""
        return solve(self.light, latent, self.measured, self.variance, size, varying=varying)


def window_psf(
    window: Window, latent: Latent, size: int, *, varying: bool = False
) -> tuple[Solved, tuple[float, float]]:
    """Measure the PSF of one window; say also how far the latent picture was moved."""
    # nearly centred so, the kernel needs no interpolation, which would soften a peak as narrow as a pixel
    _, shift = roughly(window, latent, min(SMALL, size))
    return window.solved(latent(shift, size // 2), size, varying=varying), shift


def roughly(window: Window, latent: Latent, size: int = SMALL) -> tuple[Kernel, tuple[float, float]]:
    """Find a small kernel of a window, and how far the photo lies beyond the latent picture."""
    shift = (0.0, 0.0)
    for _ in range(2):
        first = window.solved(latent(shift, size // 2), size)
        shift = shift[0] + first.shift[0], shift[1] + first.shift[1]
        if max(map(abs, shift)) > _MOST_SHIFT:
            raise NotEnoughEvidenceError("the window lies elsewhere than the rest of the reference says")
        if max(map(abs, first.shift)) < 0.02:
            break
    return first.kernel, shift


def window_corners(
    shape: tuple[int, int], side: int, across: int, down: int, margin: int
) -> list[tuple[int, int]]:
    """Top left corners of windows spread evenly over a frame, `margin` pixels away from its rim."""
    last = shape[0] - side - margin, shape[1] - side - margin
    if min(last) < margin:
        return []
    rows = np.unique(np.rint(np.linspace(margin, last[0], down)).astype(int))
    cols = np.unique(np.rint(np.linspace(margin, last[1], across)).astype(int))
    return [(int(row), int(col)) for row in rows for col in cols]
