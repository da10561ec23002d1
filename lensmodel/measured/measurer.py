"""What all ways of measuring share: `Measurer`, windows of a photo, and the PSF of one (`solve`).

It is found by weighted least squares against the sharp picture that the window shows.

For the pixels p that the sensor measured in a window,

    y(p) = sum_t k(t) x(p - t) + sum_j c_j q_j(p) + n(p)          var n(p) = s(p)²

so that only the latent picture x must be known everywhere, and a mosaic needs no demosaicing. The q_j, terms
of a quadratic, are slow changes of light over the blurred picture; the c_j are eliminated (R. Frisch and F.
Waugh, Econometrica 1, 1933). In a window hardly wider than the kernel a quadratic takes its wings as well:
there, a constant (`even`). Every value of the kernel has a normal prior of mean 0, whose width falls with the
distance d to the middle as the light of a lens does,  t(d) = T / (1 + (d / D)²).  The kernel is the minimum
of

    sum_p (y - k * x - c)² / (q s²) + sum_t k(t)² / t(d)²

over all k >= 0 whose sum is that of the minimum over all k, where q >= 1 is the mean of the squared residuals
over what the noise explains. Without the sum, k >= 0 alone would cut off one half of the noise and keep the
other: hundreds of values around a small core then add up to a halo that is not there. (Where the latent
picture has noise of its own, which is taken off, the free minimum is not determined, and k >= 0 is all.) Its
expected error is  e² = trace (X'X / q + diag(1 / t²))^-1 / |k|².

A kernel that changes within the window (`varying`) is linear in the place, k + u k_u + v k_v with u and v
from -1 to 1 over its rows and columns; k_u and k_v are eliminated too. It is found at the phase between
pixels that fits best: a kernel that is not negative on one grid of pixels is so on no other, if it has a peak
as narrow as a pixel. Moved by half a pixel, the peak rings along its row and column, and k >= 0 cuts one half
of that off. So X S(d) k is compared with y, where S(d) moves a kernel by d pixels (by sinc, exact for a
picture without frequencies beyond the pixels'), and d minimises the misfit. Where the kernel is smooth, any d
will do, and a weak prior keeps its centre of mass in the middle.

Sources: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4 (known sharp
picture, non-negative least squares); M. Delbracio et al., IJCV 96, 2012, section 3.
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.numerics import fista, nonnegative_least_squares, on_simplex
from lensmodel.core.psf import MEASURED, PsfSample, as_kernel, centred, centroid
from lensmodel.core.types import (
    CHANNELS,
    Channel,
    FieldPosition,
    Kernel,
    LensSettings,
    NoiseModel,
    StepHook,
    ignore_step,
)
from lensmodel.photo import LinearPhoto


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPsf:
    """A PSF measured at one place of a photo."""

    kernel: Kernel  # (k, k), impulse response on the sensor's grid, centre of mass on the middle pixel
    position: FieldPosition  # middle of what it was measured on
    channel: Channel  # colour plane
    error: float  # relative L2 distance to the truth that the method expects
    pixel: tuple[float, float]  # middle of what it was measured on, (row, col)
    side: int  # side in pixels of the window that it was measured on

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", as_kernel(self.kernel))


Prepared: TypeAlias = tuple[Sequence[Any], Callable[[Any, Channel], MeasuredPsf]]


class Measurer(ABC):
    """One way to measure the PSF of a lens on photos made for it."""

    name: ClassVar[str]
    version: ClassVar[int]
    photos: ClassVar[int]
    """How many photos one measurement takes."""
    nothing: ClassVar[str]
    """What is missing where no place gives a PSF."""

    def measure(
        self,
        photos: Sequence[LinearPhoto],
        *,
        size: int,
        channels: Sequence[Channel] = CHANNELS,
        on_step: StepHook = ignore_step,
    ) -> list[MeasuredPsf]:
        """Measure the PSF wherever the photos, as many as `photos` says, show it.

        The first is the one whose PSF is measured; kernels have an odd side of `size` pixels. `on_step` is
        called after each place, and now and then before the first one, with nothing done of 1.
        """
        if len(photos) != self.photos:
            raise InvalidInputError(
                f"measuring by {self.name} takes {self.photos} photo{'s' * (self.photos > 1)} at a time, "
                f"got {len(photos)}"
            )
        if size < 3 or size % 2 == 0:
            raise InvalidInputError(f"kernels have an odd side of 3 pixels or more, got {size}")
        places, psf_in = self._prepare(photos, size, on_step)
        psfs = []
        for done, place in enumerate(places, start=1):
            for channel in channels:
                with contextlib.suppress(LensModelError):
                    psfs.append(psf_in(place, channel))
            on_step(done, len(places))
        if not psfs:
            raise NotEnoughEvidenceError(self.nothing)
        return psfs

    @abstractmethod
    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find the places that photos show, and what measures one of them in a colour or raises."""


def samples_of(
    measured: Sequence[MeasuredPsf],
    method: Measurer,
    photo: LinearPhoto,
    *,
    photo_id: str,
    settings: LensSettings,
) -> list[PsfSample]:
    """Make samples of measurements, as a `LensModel` takes them.

    The estimator is called `measured-NAME/VERSION`; the weight is 1, the error is the measurement's own.
    """
    return [
        PsfSample(
            kernel=psf.kernel,
            position=psf.position,
            settings=settings.with_channel(psf.channel),
            weight=1.0,
            photo=photo_id,
            pixel_pitch_um=photo.info.metadata.pixel_pitch_um,
            estimator=f"{MEASURED}{method.name}/{method.version}",
            error=psf.error,
            half_diagonal_px=photo.frame.half_diagonal,
        )
        for psf in measured
    ]


def psf_at(
    photo: LinearPhoto,
    channel: Channel,
    kernel: Kernel,
    pixel: NDArray[np.floating],
    side: int,
    error: float,
    most: float = math.inf,
) -> MeasuredPsf:
    """Say where a kernel was measured; refuse one whose expected error is as large as that of a blind one."""
    if not error < most:  # nor one that is not known
        raise NotEnoughEvidenceError(f"the kernel is expected to be wrong by {error:.0%}")
    row, col = map(float, pixel)
    return MeasuredPsf(kernel, photo.frame.position(row, col), channel, error, (row, col), side)


# --- the kernel of a window ------------------------------------------------------------------------


def quadratic(r: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terms 1, r, c, r², rc, c² of a smooth change of light, last axis."""
    r, c = np.broadcast_arrays(r, c)
    return np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)


def window_terms(side: int, margin: int) -> NDArray[np.float64]:
    """Terms of `quadratic` in sides of a window from its middle, with a margin around it."""
    t = (np.arange(-margin, side + margin) - (side - 1) / 2.0) / side
    return quadratic(t[:, None], t[None, :])


PEAK: Final = 0.5  # T: so much light has the middle of the sharpest kernel, a pixel and some diffraction
REACH: Final = 2.5  # D in pixels: light 10 px away is expected below 3 percent, ten times that of wide halos
_ROWS: Final = 2048  # of the design matrix at once: a whole window would take hundreds of megabytes (chosen)
_STEPS: Final = 300  # of the projected gradient: more only cost time (chosen)
_STILL: Final = 1e-7  # of the light: no value moves by more
_NO_KERNEL: Final = "no kernel explains this window; the latent picture does not match it"


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
    latent_noise: NDArray[np.floating] | None = None,
    *,
    even: bool = False,
    varying: bool = False,
) -> Solved:
    """Find the kernel of odd side `size` that makes the latent picture the observed one.

    The latent picture has a margin of half a kernel; `latent_noise`, shape (2 size - 1, 2 size - 1), is the
    autocovariance of noise that it has itself, which would pass for picture and make the kernel too wide.
    Only without it may the kernel be `varying`; that needs no centring.
    """
    if int(measured.sum()) < size * size:
        raise NotEnoughEvidenceError(
            f"{int(measured.sum())} pixels count, {size * size} are needed for a kernel of side {size}"
        )
    weight = np.where(measured, 1.0 / np.maximum(variance, 1e-12), 0.0)
    whole = _normal_equations(observed, latent, weight, size, even=even, varying=varying)
    if latent_noise is not None:
        # that of all values of a window of `size` pixels, shape (size², size²)
        row, col = (i[:, None] - i + size - 1 for i in np.divmod(np.arange(size * size), size))
        whole = replace(whole, a=whole.a - latent_noise[row, col] * weight.sum())
    prior = 1.0 / prior_width(size) ** 2
    count, misfit, moved = int(measured.sum()), 1.0, (0.0, 0.0)
    k = np.zeros(size * size)
    eq = whole.over(misfit, prior)
    for _ in range(2):  # the second time with the residuals of the first
        if latent_noise is None:
            k = _bounded(eq.a + np.diag(prior), eq.b, k)
        else:  # less its noise a latent picture leaves directions open, and the free minimum's sum with them
            k = nonnegative_least_squares(eq.a + np.diag(prior), eq.b, k, _STEPS)
        rest = eq.power - 2.0 * float(eq.b @ k) + float(k @ eq.a @ k)
        misfit = max(misfit * rest / count, 1.0)
        eq = whole.over(misfit, prior)
    if varying:
        k, moved = _on_its_grid(eq, prior, k, size)
    light = float(k.sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError(_NO_KERNEL)
    kernel = as_kernel(k.reshape(size, size))
    off = centroid(kernel)
    return Solved(
        kernel=kernel,
        light=light,
        shift=(off[0] + moved[0], off[1] + moved[1]),
        error=_error_of(eq.a + np.diag(prior), k),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of the kernel, or of k, k_u and k_v: k'Ak/2 - b'k, and y'Wy."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    power: float

    def over(self, misfit: float, prior: NDArray[np.float64]) -> _Equations:
        """Divide by the misfit, and eliminate k_u and k_v where they are there."""
        scaled, n = _Equations(self.a / misfit, self.b / misfit, self.power / misfit), len(prior)
        if len(self.b) == n:
            return scaled
        inner = scaled.a[n:, n:] + np.diag(np.tile(prior / CHANGE**2, 2))
        return scaled.without(n, lambda right: scipy.linalg.solve(inner, right, assume_a="sym"))

    def without(self, n: int, solved: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> _Equations:
        """Eliminate all unknowns but the first n (Schur's complement); `solved` divides by their block."""
        across, b = self.a[n:, :n], self.b[n:]
        by = solved(np.concatenate([across, b[:, None]], axis=1))
        return _Equations(
            self.a[:n, :n] - across.T @ by[:, :n],
            self.b[:n] - across.T @ by[:, n],
            self.power - float(b @ by[:, n]),
        )


def _normal_equations(
    observed: NDArray[np.floating],
    latent: NDArray[np.floating],
    weight: NDArray[np.float64],
    size: int,
    *,
    even: bool,
    varying: bool,
) -> _Equations:
    """Normal equations of k, or of k, k_u and k_v, with slow changes of light eliminated."""
    # a constant is one of the slow changes; without it single precision holds the detail
    latent = np.asarray(latent - latent.mean(), dtype=np.float32)
    observed = np.asarray(observed - observed[weight > 0].mean(), dtype=np.float32)
    views = sliding_window_view(latent, (size, size))[:, :, ::-1, ::-1]
    u, v = (np.linspace(-1.0, 1.0, n) for n in weight.shape)
    terms = quadratic(u[:, None], v[None, :]).astype(np.float32)
    rows, cols = np.nonzero(weight)
    n = (3 if varying else 1) * size * size
    of_light = 1 if even else terms.shape[-1]
    gram = np.zeros((n + of_light + 1,) * 2)
    for first in range(0, rows.size, _ROWS):
        part = rows[first : first + _ROWS], cols[first : first + _ROWS]
        x, slow = views[part].reshape(part[0].size, -1), terms[part]
        moving = [x * slow[:, 1:2], x * slow[:, 2:3]] if varying else []
        columns = np.concatenate([x, *moving, slow[:, :of_light], observed[part][:, None]], axis=1)
        columns *= np.sqrt(weight[part]).astype(np.float32)[:, None]
        gram += columns.T @ columns
    light = np.linalg.pinv(gram[n:-1, n:-1], hermitian=True)  # few pixels may not tell all terms apart
    return _Equations(gram[:-1, :-1], gram[:-1, -1], float(gram[-1, -1])).without(
        n, lambda right: light @ right
    )


def _bounded(
    a: NDArray[np.float64], b: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 of the free minimum's sum."""
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    lift = max(1e-6 * largest - float(eigenvalues[0]), 0.0)  # single precision may leave it indefinite
    a = a + lift * np.eye(len(b))
    light = float(scipy.linalg.solve(a, b, assume_a="pos").sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError(_NO_KERNEL)
    return _of_sum(a, b, start, light, largest + lift, _STEPS)


def _of_sum(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    start: NDArray[np.float64],
    light: float,
    largest: float,
    steps: int,
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 of a sum; `largest` bounds the eigenvalues of A."""
    return fista(
        lambda k: a @ k - b,
        start,
        1.0 / largest,
        lambda k: on_simplex(k, light),
        steps=steps,
        still=_STILL * light,
    )


def prior_width(size: int) -> NDArray[np.float64]:
    """Return t(d), shape (k²,)."""
    t = np.arange(size) - size // 2
    return (PEAK / (1.0 + (t[:, None] ** 2 + t[None, :] ** 2) / REACH**2)).ravel()


def _error_of(precision: NDArray[np.float64], k: NDArray[np.float64]) -> float:
    """Root of the posterior variance of all values over the norm of the kernel; 1 is the worst."""
    try:
        inverse = scipy.linalg.inv(precision, check_finite=False)
    except scipy.linalg.LinAlgError:
        return 1.0
    variance = float(np.maximum(np.diag(inverse), 0.0).sum())
    return min(math.sqrt(variance / float(k @ k)), 1.0)


# Width of the prior of k_u and k_v over that of k (chosen: at three times as much nothing changed; measured
# once, no command repeats it)
CHANGE: Final = 0.3
CENTRED_PX: Final = 0.3  # expected distance of the centre of mass from the middle: that of the match (chosen)
_MOST_PX: Final = 1.0  # largest phase along an axis: a whole pixel is another match (chosen)
_FIRST_PX, _LAST_PX = 0.25, 0.03  # steps of the search for the phase, coarse to fine (chosen)
_SEARCHED: Final = 100  # steps from one phase to the next: only the order of their misfits counts (chosen)


def _on_its_grid(
    eq: _Equations, prior: NDArray[np.float64], start: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Kernel and phase (row, col) in pixels at which k >= 0 explains the window best."""
    light, k = float(start.sum()), start
    # moving a kernel by sinc lengthens none; the prior is the same for all
    largest = 1.02 * float(
        scipy.linalg.eigvalsh(eq.a + np.diag(prior), subset_by_index=(len(prior) - 1,) * 2)[0]
    )

    def cost(phase: NDArray[np.float64]) -> float:
        nonlocal k
        a, b = _moved(eq, phase, size)
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
    return k, (float(best.x[0]), float(best.x[1]))


def _moved(
    eq: _Equations, phase: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """S'AS and S'b, axis by axis."""
    n, t = size * size, np.arange(size)
    down, across = (np.sinc(t[:, None] - t - by) for by in phase)

    def left(m: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = (down.T @ m.reshape(size, -1)).reshape(size, size, -1)
        return np.asarray(np.matmul(across.T, rows).reshape(n, -1))

    return left(left(eq.a).T), left(eq.b[:, None])[:, 0]


# `latent(shift, margin)`: the sharp picture of a window, moved down and right by `shift` pixels
Latent = Callable[[tuple[float, float], int], NDArray[np.floating]]
SMALL: Final = 15  # side of the kernel by which the middle is found: its wings hardly move it
NEAR_CLIP: Final = 0.97  # of the clipping level, above which no pixel is believed: sensors bend before it
_FEWEST: Final = 64  # pixels of a window to fit its light to: five to ten for each term (chosen)
_MOST_SHIFT: Final = 3.0  # pixels; beyond, the small kernel is cut off


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A square window of one colour of a photo."""

    photo: LinearPhoto
    channel: Channel
    corner: tuple[int, int]  # top left pixel, (row, col)
    light: NDArray[np.float64]  # (side, side)
    measured: NDArray[np.bool_]  # which pixels the sensor measured in this colour, unclipped

    @classmethod
    def of(cls, photo: LinearPhoto, channel: Channel, corner: tuple[int, int], side: int) -> Window:
        """Cut it out of a photo."""
        (row, col), index = corner, CHANNELS.index(channel)
        light = photo.planes[index, row : row + side, col : col + side].astype(np.float64)
        measured = np.asarray(light < np.float32(NEAR_CLIP * photo.clip[index]))
        if photo.cfa is not None:
            rows, cols = (row + np.arange(side)) % 2, (col + np.arange(side)) % 2
            measured &= np.asarray(photo.cfa)[rows[:, None], cols[None, :]] == index
        return cls(photo, channel, corner, light, measured)

    def require_measured(self) -> NDArray[np.bool_]:
        """Return which pixels were measured; raises where these are too few to fit its light to."""
        if int(self.measured.sum()) < _FEWEST:
            raise NotEnoughEvidenceError("nearly all pixels of a window are clipped; expose less")
        return self.measured

    @property
    def noise(self) -> NoiseModel:
        """Noise of the pixels that were measured."""
        return (self.photo.sensor_noise or self.photo.noise)[CHANNELS.index(self.channel)]

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of the noise, its mean for each pixel.

        By its own level a pixel that is dark by chance would count more than others.
        """
        own = self.noise.shot * np.maximum(self.light, 0.0) + self.noise.read
        return np.full(own.shape, float(own[self.measured].mean()) if self.measured.any() else 1.0)

    def psf(self, kernel: Kernel, error: float, floor: float, most: float) -> MeasuredPsf:
        """Say that a kernel was measured here, with an error of its own and one that no window shows."""
        side = len(self.light)
        middle, whole = np.add(self.corner, (side - 1) / 2.0), float(np.hypot(error, floor))
        return psf_at(self.photo, self.channel, kernel, middle, side, whole, most)


def window_psf(
    window: Window, latent: Latent, size: int, *, latent_noise: NDArray[np.floating] | None = None
) -> tuple[Kernel, Solved, tuple[float, float]]:
    """Measure the PSF of one window.

    First a small kernel, whose centre of mass says how far the photo lies beyond the latent picture; that
    is moved, and solved again, so that the kernel comes out nearly centred and needs no interpolation, which
    would soften a peak as narrow as a pixel.
    """
    _, shift = roughly(window, latent, min(SMALL, size))
    given = window.light, latent(shift, size // 2), window.measured, window.variance, size
    if latent_noise is None:
        solved = solve(*given, varying=True)
        return solved.kernel, solved, shift
    # less its noise a latent picture says too little of how the kernel changes, and of the best grid
    solved = solve(*given, latent_noise)
    return centred(solved.kernel), solved, shift


def roughly(window: Window, latent: Latent, size: int = SMALL) -> tuple[Solved, tuple[float, float]]:
    """Find a small kernel of a window."""
    shift = (0.0, 0.0)
    for _ in range(2):
        first = solve(window.light, latent(shift, size // 2), window.measured, window.variance, size)
        shift = shift[0] + first.shift[0], shift[1] + first.shift[1]
        if max(map(abs, shift)) > _MOST_SHIFT:
            raise NotEnoughEvidenceError("the window lies elsewhere than the rest of the reference says")
        if max(map(abs, first.shift)) < 0.02:
            break
    return first, shift


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
