"""Kernels of a fitted model at places and settings: neighbours, their mixture, and the prior's share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.far_light import with_far_light
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.answer import PAPER
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.field.neighbourhood import Neighbourhood
from lensmodel.model.field.smoothers import Smoother, smoothers
from lensmodel.model.fitting import Fit
from lensmodel.model.modes import Mixture, answered, between
from lensmodel.model.pixels import Pixels
from lensmodel.model.prior import Prior
from lensmodel.model.trust.support import USUAL_ERROR, measured_share
from lensmodel.model.wavefront.physical_mean import Physics
from lensmodel.model.wavefront.zoom import nearest

_AROUND: Final = {**va.FALLBACK, "r": 0.15, "phi": 0.5}
"""Bandwidths within which samples speak of a place instead of a prior: they do not shrink as more come in,
else a prior would never yield. Blur changes little over them; wider ones let the centre silence the prior of
the corners (chosen)."""


class Predictor:
    """A fit, ready to answer.

    Parameters
    ----------
    fit : Fit
    method : str
        Name in `smoothers`.
    prior : Prior or None
    """

    def __init__(self, fit: Fit, method: str, prior: Prior | None) -> None:
        scale = va.scales(fit.bandwidth)
        self.fit = fit
        self.prior = prior
        self.pixels = Pixels(fit.unit, fit.pixel)
        self._far_light = None if fit.mode == PAPER else fit.far_light()
        self._neighbourhood = Neighbourhood(fit.index, fit.validation.votes, scale, smoothers.create(method))

    @property
    def smoother(self) -> Smoother:
        """How neighbours are weighed."""
        return self._neighbourhood.smoother

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Return the neighbours of some places and their weights."""
        return self._neighbourhood.near(positions, settings)

    def ask(
        self, positions: Sequence[FieldPosition], settings: LensSettings, size: int
    ) -> tuple[Answers, Mixture, NDArray[np.float64]]:
        """Answer in the pixels of the samples.

        Returns
        -------
        answers : Answers
            Neighbours and weights.
        mixture : Mixture
            Kernels `(n, size, size)`, the prior included, and their held-out errors.
        shares : ndarray, shape (n,)
            Share of the prior in them.
        """
        fit = self.fit
        near = self.near(positions, settings)
        widths = fit.widths.over(np.array([va.point(p, settings) for p in positions]))
        end, share = nearest(fit.ends, settings)

        expected = np.sqrt(near.mean(np.where(fit.expected > 0.0, fit.expected, USUAL_ERROR**2)))

        def mixed(physical: Physics | None) -> Mixture:
            return answered(fit, physical, near, positions, settings, widths, size, expected)

        mixture = mixed(fit.physical) if end is None or share < 1.0 else None
        if end is not None:
            own = mixed(end.physical)
            mixture = own if mixture is None else between(own, mixture, share)
        assert mixture is not None
        if self._far_light is not None:
            # kernels that were measured show all of the light
            far = self._far_light.shares(positions, settings) * (1.0 - measured_share(expected))
            mixture = replace(mixture, kernels=with_far_light(mixture.kernels, far), far_light=far)
        shares = np.zeros(len(positions))
        if self.prior is not None:
            shares = self.prior.share(self._samples_around(positions, settings))
            pitch, half_diagonal = self.pixels.as_question
            other = self.prior.kernels(
                positions, settings, size, pitch_um=pitch, half_diagonal_px=half_diagonal
            )
            part = shares[:, None, None]
            mixture = replace(
                mixture,
                kernels=(1.0 - part) * mixture.kernels + part * other,
                far_light=(1.0 - shares) * mixture.far_light,
            )
        return near, mixture, shares

    def _samples_around(
        self, positions: Sequence[FieldPosition], settings: LensSettings
    ) -> NDArray[np.float64]:
        """How many samples speak of each place."""
        points, votes, scale = self.fit.index.points, self.fit.validation.votes, va.scales(_AROUND)
        gaps = [va.squared_distances(points, va.point(place, settings), scale) for place in positions]
        return np.array([float(votes @ np.exp(-0.5 * gap)) for gap in gaps])
