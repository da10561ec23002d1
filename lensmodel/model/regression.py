"""Nadaraya-Watson regression over kernels in rotated local frames (paper, section 6.2, eq. 4-8).

The weight of a sample factorises into one of place and settings, common to all its pixels, and one of (u, v).
So the sum over all pixels of all samples is one of kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i

with C_i the sample's kernel in its own radial frame. Departures from the paper: n in eq. (8) counts PSFs, not
pixels; the smoothing over (u, v) is that of the spline, because a bandwidth of pixels would widen the PSF;
unless the mode is "paper", kernels are scaled to the width of the place before averaging (`widths`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import camera_bodies, support
from lensmodel.model import variables as va
from lensmodel.model.answer import PAPER, ModelSettings
from lensmodel.model.bandwidths import CrossValidation, bandwidth, by_rule, cross_validate
from lensmodel.model.local_frame import LocalKernels
from lensmodel.model.neighbours import Answers, Neighbourhood
from lensmodel.model.widths import WidthField

_DRIFT: Final = 0.15
"""Relative L2 error for each unit of `support` beyond the first to the nearest sample (chosen)."""

_WIDEST: Final = 255
"""Pixels along a side of the widest kernel that is made for coarser pixels to be asked for: memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Kernels of samples, prepared for questions."""

    pitch_um: float | None  # pixel pitch that all kernels are brought to; None where none is known
    widths: WidthField
    local: LocalKernels
    where: NDArray[np.float64]  # (n, 5), points of the samples in units of `support`
    validation: CrossValidation
    # (n,), errors that the estimators expect of their samples; 0 where they expect nothing
    expected: NDArray[np.float64]
    photos: NDArray[np.object_]  # (n,)
    bandwidth: dict[str, float]  # bandwidths in use
    neighbourhood: Neighbourhood  # which samples answer a question, and with which weights

    @classmethod
    def of(cls, samples: Sequence[PsfSample], settings: ModelSettings) -> Regression:
        """Fit widths, bandwidths and robust weights; `NoSamplesError` if no sample has a weight."""
        normalised = settings.mode != PAPER
        base = np.array([s.weight for s in samples])
        if not (base > 0).any():
            raise NoSamplesError(f"none of the {len(samples)} samples has a weight; include a photo again")
        pitch_um = camera_bodies.usual_pitch(samples)
        common = camera_bodies.at_pitch(samples, pitch_um)
        points = va.points(common)
        widths = WidthField.fit(common, base) if normalised else WidthField()
        local = LocalKernels.of(common, points, widths)
        validation = cross_validate(common, settings, local, points, base)
        if normalised and validation.spoilt:
            # a spoilt photo has bent the widths too: fit them again without it
            widths = WidthField.fit(common, validation.weights)
            local = local.rescaled(points, widths)
            validation = cross_validate(common, settings, local, points, base)
        used = bandwidth(by_rule(points), settings, validation.choice)
        return cls(
            pitch_um,
            widths,
            local,
            support.points(common),
            validation,
            expected=np.array([0.0 if s.error is None else min(s.error, 1.0) for s in samples]),
            photos=np.array([s.photo for s in samples], dtype=object),
            bandwidth=used,
            neighbourhood=Neighbourhood(points, validation.weights, va.scales(used)),
        )

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Return the neighbours of some places and their weights."""
        return self.neighbourhood.near(positions, settings)

    def kernels(
        self,
        near: Answers,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int,
        pitch_um: float | None,
    ) -> NDArray[np.float64]:
        """Return the kernels that neighbours make, in pixels of some pitch, shape (q, size, size)."""
        widths = self.widths.over(np.array([va.point(p, settings) for p in positions]))
        angles = np.array([p.phi for p in positions])
        own = self.pitch_um
        if own is None or pitch_um is None or camera_bodies.alike(own, pitch_um):
            return self.local.kernels(near, angles, widths, size)
        inside = min(2 * math.ceil(size / 2 * pitch_um / own) + 1, max(_WIDEST, size))
        kernels = self.local.kernels(near, angles, widths, inside)
        return np.stack([camera_bodies.rescaled(kernel, own, pitch_um, size) for kernel in kernels])

    def error(self, near: Answers, found: support.Support) -> float:
        """Expected relative L2 error of one answer.

        With held-out errors h, of which the scatter s of neighbours is a part, m independent photos, and what
        the estimators expect t, all near the place, and the distance d to the nearest sample::

            own^2 = max(h^2 - s^2 (1 + 1/m), h^2 / 9) + s^2 / m       shared^2 = max(t^2 - s^2, t^2 / 4)
            error^2 = own^2 + shared^2 + (0.15 max(d - 1, 0))^2

        Estimators that err alike do not scatter: at least half of what they expect is taken for shared.
        """
        weight, rows = near.weights, near.rows
        _, number = np.unique(self.photos[rows].astype(str), return_inverse=True)
        independent = 1.0 / float((np.bincount(number, weight) ** 2).sum())
        held_out = float(weight @ self.validation.errors[rows] ** 2)
        scatter = min(float(weight @ self.validation.noise[rows]), held_out)
        own = max(held_out - scatter * (1.0 + 1.0 / independent), held_out / 9.0) + scatter / independent
        expected = float(weight @ self.expected[rows] ** 2)
        if len(self.where) == 1 and expected > 0.0:
            own = 0.0  # no other sample foretells it
        shared = max(expected - scatter, expected / 4.0)
        drift = _DRIFT * max(found.nearest - 1.0, 0.0)
        return min(math.sqrt(own + shared + drift * drift), 1.0)

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels."""
        return self.local.nbytes
