"""Questions to a lens model and its answers: the variables besides (u, v), and distances.

By the one distance the regression weighs samples (paper, eq. 7), in bandwidths::

    d^2 = ((r - r_i) / h_r)^2 + |c(phi) - c(phi_i)|^2 / h_phi^2 + sum over the settings

with c on the unit circle, so that pi and -pi are neighbours: |c - c_i| is the chord 2 sin(d/2).
Near the centre of the image all angles are neighbours, so the circle shrinks with r there.

The other, `nearest`, says how far a question lies from all samples, in units in which a PSF changes by about
as much. They do not shrink as samples come, as bandwidths do: what is near stays near::

    d^2 = |p - p_i|^2 / 0.2^2 + (stops apart)^2 + (octaves of focal length apart / 0.5)^2
          + (dioptres of focus distance apart / 0.5)^2,        p = r (cos phi, sin phi)

A setting that is unknown, in the question or in the sample, drops out of both sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM, FieldPosition, Kernel, LensSettings

Array: TypeAlias = NDArray[np.float64]

# of x, y, stops, octaves and dioptres (chosen: kernels of usual lenses differ by 0.1 to 0.2 over each)
UNITS: Final = np.array([0.2, 0.2, 1.0, 0.5, 0.5])
FAR: Final = 2.5  # units: a Gaussian has fallen to 0.04 there (chosen)
_CENTER_R = 0.25  # half-diagonals: inside, directions fade, since at the centre there is none (chosen)

PAPER: Final = "paper"
MODES: Final = ("default", PAPER)  # ways to answer from samples, see `LensModel`


@dataclass(frozen=True, slots=True, eq=False)
class PsfAnswer:
    """A PSF with what stands behind it.

    `kernel`, float64 of shape (size, size), is in the image frame, centred, of sum 1; `predicted_error` its
    expected relative L2, 0..1. `effective_samples` is 1 / sum W^2 of the samples' weights W in the answer, of
    sum 1, `photos` the number of their photos, and `extrapolated` whether none is near the question in place
    and settings. `weights` is the fingerprint of the network's weights, empty where none took part, and
    `ring_error`, shape (8,), the expected r.m.s. error of the transfer function in rings of frequency; None
    but of the network alone.
    """

    kernel: Kernel
    predicted_error: float
    effective_samples: float
    photos: int
    extrapolated: bool
    weights: str = ""
    ring_error: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What one way of answering says: the network or the regression."""

    kernel: Kernel
    error: float  # expected relative L2
    weights: Array  # (n,), of the samples in the answer, of sum 1
    photos: NDArray[np.str_]  # (n,), of these samples
    nearest: float  # distance of the nearest of them, in units
    ring_error: Array | None = None


# --- places and settings -------------------------------------------------------------------------


def point(position: FieldPosition, settings: LensSettings) -> Array:
    """Coordinates of a place and settings, shape (7,); NaN = unknown.

    They are r, phi as cosine and sine, stops, wavelength in nm, octaves of focal length, dioptres.
    """
    share = min(position.r / _CENTER_R, 1.0)
    turned = share * math.cos(position.phi), share * math.sin(position.phi)
    given = (settings.stops, settings.focal_mm, settings.focus_m)
    stops, focal, focus = (math.nan if value is None else value for value in given)
    wave = WAVELENGTH_NM[settings.channel]
    return np.array([position.r, *turned, stops, wave, math.log2(focal), 1.0 / focus])


def points(samples: Sequence[PsfSample]) -> Array:
    """Coordinates of samples, shape (n, 7)."""
    return np.array([point(s.position, s.settings) for s in samples])


def vectors(where: Array) -> Array:
    """(x, y) to the right and up, in half-diagonals, of points `(..., 7)`, shape (..., 2)."""
    r = where[..., :1]
    return np.asarray(where[..., 1:3] * (r / np.minimum(np.maximum(r, 1e-30) / _CENTER_R, 1.0)))


def squared_distances(where: Array, asked: Array, scale: Array) -> Array:
    """Squared distances in bandwidths of points `(n, 7)` from one point `(7,)`; unknowns drop out."""
    gap = np.nan_to_num((where - asked) / scale, copy=False)
    return np.asarray((gap * gap).sum(axis=-1))


def in_units(where: Array) -> Array:
    """Points `(..., 7)` in `UNITS`, shape (..., 5): x, y, stops, octaves, dioptres; NaN = unknown."""
    return np.concatenate([vectors(where), where[..., [3, 5, 6]]], axis=-1) / UNITS


def nearest(where: Array, asked: Array) -> float:
    """Distance from a point `(5,)` to the nearest of others `(n, 5)`; unknowns drop out."""
    return float(np.linalg.norm(np.nan_to_num(where - asked), axis=1).min())
