"""Several answers to one question, mixed by how wrong they were near the place.

With e the relative L2 of samples that an estimate was not fitted to, weighed as the question weighs them,
its share is proportional to e^-4: where one is much worse than the others it loses its say by itself.

A wavefront fitted to the spectra of all patches (`from_spectra`) makes other mistakes than kernels that were
estimated one by one. Where aperture and pixel pitch tell how wide diffraction is, it was nearer to the truth
than they in every class of width behind simulated lenses of development seeds, and alone has the say. Where
they do not, it cannot tell blur below half a pixel from diffraction, and is mixed with the kernels by width.
`python -m lensmodel.lab.model.pooled_evidence` prints what that gives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import rms_width
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.field.cross_validation import CrossValidation
from lensmodel.model.field.kriging import as_kernels, field_vector
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.wavefront.physical_mean import Physics

WAVEFRONT_SHARE: Final = 0.75
"""Of the wavefront in the mode `both`: `python -m lensmodel.lab.model.joint_answer`."""

_SILENT = 1e-3
_KERNEL_ERROR, _LEAST_KERNEL_ERROR, _NARROW_PX = 0.35, 0.1, 0.8
_EVEN_PX, _STEEP = 0.52, 12
_NARROWEST_PX = 0.3
"""Kernels that end in a point, outside all samples for example, say no more than that blur may be narrow."""


def agreed_share(width: NDArray[np.float64], *, diffraction_known: bool) -> NDArray[np.float64]:
    """Share of an agreed wavefront by root mean square width in pixels.

    All where its diffraction is known; else a half at 0.52 px, more above.
    """
    if diffraction_known:
        return np.ones_like(width)
    return np.asarray(width**_STEEP / (width**_STEEP + _EVEN_PX**_STEEP))


def kernel_error(width: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected relative L2 of kernels that each patch gave alone, by width in pixels."""
    return np.maximum(_KERNEL_ERROR * np.minimum(width / _NARROW_PX, 1.0), _LEAST_KERNEL_ERROR)


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Mixed answers to several questions.

    Parameters
    ----------
    kernels : ndarray, shape (q, size, size)
    squared : ndarray, shape (q,)
        Squared held-out errors near the places.
    usual : float
        The same of the best estimate, all over the field.
    shares : ndarray, shape (q, 3)
        Weights of the local frame, the image frame and the wavefront.
    averaged : ndarray, shape (q,)
        Squared held-out errors of the local frame alone near the places.
    apart : ndarray, shape (q,)
        How far the wavefront moves the answer from the local frame's kernel, relative L2.
    """

    kernels: NDArray[np.float64]
    squared: NDArray[np.float64]
    usual: float
    shares: NDArray[np.float64]
    averaged: NDArray[np.float64]
    apart: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Estimates besides the regression in the local frame.

    Parameters
    ----------
    validation : CrossValidation
        With the image frame, if that takes part.
    scale : ndarray, shape (7,)
        Bandwidths.
    physical : Physics or None
        The wavefront; None if it takes no part.
    """

    validation: CrossValidation
    scale: NDArray[np.float64]
    physical: Physics | None

    def mixed(
        self,
        kernels: NDArray[np.float64],
        near: Answers,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
    ) -> Mixture:
        """Mix answers of the local frame with those of the others.

        Parameters
        ----------
        kernels : ndarray, shape (q, size, size)
            Answers of the local frame.
        near : Answers
            Samples near the places, and weights that say how near.
        """
        validation, size = self.validation, kernels.shape[1]
        squared, usual = np.full((len(positions), 3), math.inf), np.full(3, math.inf)
        errors_of = [validation.errors, validation.image_errors, None]
        if self.physical is not None:
            errors_of[2] = self.physical.extended_errors(len(validation.votes))
        for index, errors in enumerate(errors_of):
            if errors is not None:
                squared[:, index] = near.mean(errors**2)
                usual[index] = float(errors @ errors) / len(errors)
        agreed = self.physical is not None and self.physical.agreed
        parts = np.maximum(squared, 1e-15) ** -2.0
        if agreed:
            # what all patches agree on is not judged by kernels that each of them made alone
            parts[:, 2] = 0.0
        shares = parts / parts.sum(axis=1, keepdims=True)
        shares[shares < _SILENT] = 0.0
        shares /= shares.sum(axis=1, keepdims=True)
        averaged, apart = squared[:, 0].copy(), np.zeros(len(positions))
        light = shares[:, 0, None, None] * kernels
        mixed = np.flatnonzero(shares[:, 1])
        if validation.image is not None and mixed.size:
            vectors = np.array([field_vector(positions[int(i)]) for i in mixed])
            rows = validation.image.rows(vectors, va.point(positions[0], settings), self.scale)
            light[mixed] += shares[mixed, 1, None, None] * as_kernels(rows, size)
        mixed = np.flatnonzero(shares[:, 2]) if not agreed else np.arange(len(positions))
        if self.physical is not None and mixed.size:
            rows = as_kernels(self.physical.rows([positions[int(i)] for i in mixed], settings), size)
            if agreed:
                light = light / light.sum(axis=(1, 2), keepdims=True)
                width = np.sqrt(
                    [
                        max(rms_width(one), _NARROWEST_PX) * rms_width(other)
                        for one, other in zip(light, rows, strict=True)
                    ]
                )
                share = agreed_share(width, diffraction_known=self.physical.diffraction_known)
                shares *= (1.0 - share)[:, None]
                shares[:, 2] = share
                light = light * (1.0 - share)[:, None, None]
                squared[:, :2] = kernel_error(width)[:, None] ** 2
            apart[mixed] = shares[mixed, 2] * relative_l2(rows, kernels[mixed])
            light[mixed] += shares[mixed, 2, None, None] * rows
        error = np.where(shares > 0, shares * np.where(shares > 0, squared, 0.0), 0.0).sum(axis=1)
        made = light / light.sum(axis=(1, 2), keepdims=True)
        return Mixture(made, error, float(usual.min()), shares, averaged, apart)


def relative_l2(kernels: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Relative L2 of kernels about others of any brightness, shape (q,)."""
    others = others / others.sum(axis=(1, 2), keepdims=True)
    return np.asarray(np.linalg.norm(kernels - others, axis=(1, 2)) / np.linalg.norm(others, axis=(1, 2)))
