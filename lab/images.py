"""How close one picture is to another, and what a correction does to its noise."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from lensmodel.core.errors import InvalidInputError
from lensmodel.quality import to_srgb

_SSIM_WINDOW: Final = 11  # pixels: that of Wang et al. 2004


def psnr(
    image: NDArray[np.floating],
    reference: NDArray[np.floating],
    *,
    mask: NDArray[np.bool_] | None = None,
    srgb: bool = False,
) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal pictures.

    Parameters
    ----------
    image, reference : ndarray, shape (..., H, W)
        Linear light.
    mask : ndarray of bool, shape (H, W), optional
        Pixels that count.
    srgb : bool
        Compare after `to_srgb`, the usual figure for pictures.
    """
    error = _squared_error(image, reference, srgb=srgb)
    if mask is not None:
        if mask.shape != error.shape[-2:] or not mask.any():
            raise InvalidInputError(
                f"the mask must have the picture's size {error.shape[-2:]} and mark a pixel, got {mask.shape}"
            )
        error = error[..., mask]
    mean = float(error.mean())
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def ssim(image: NDArray[np.floating], reference: NDArray[np.floating], *, srgb: bool = False) -> float:
    """Structural similarity, mean over planes; Gaussian window of sigma 1.5, range 1.

    Source: Z. Wang et al., "Image quality assessment: from error visibility to structural
    similarity", IEEE TIP 13, 2004, with its constants.
    """
    _same_shape(image, reference)
    if min(image.shape[-2:]) < _SSIM_WINDOW:
        raise InvalidInputError(f"SSIM needs at least {_SSIM_WINDOW} pixels a side, got {image.shape}")
    a = to_srgb(image) if srgb else np.asarray(image, dtype=np.float64)
    b = to_srgb(reference) if srgb else np.asarray(reference, dtype=np.float64)
    planes = zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True)
    values = [
        structural_similarity(  # type: ignore[no-untyped-call]  # scikit-image ships no types
            x, y, data_range=1.0, gaussian_weights=True, use_sample_covariance=False
        )
        for x, y in planes
    ]
    return float(np.mean(values))


def noise_gain(corrected: NDArray[np.floating], original: NDArray[np.floating]) -> float:
    """Standard deviation of the noise in a flat part after a correction, over that before.

    Shading does not count, see `flat_noise`.

    Parameters
    ----------
    corrected, original : ndarray, shape (H, W)
        The same flat part of both pictures.
    """
    _same_shape(corrected, original)
    before, after = flat_noise(original), flat_noise(corrected)
    if before == 0.0:
        raise InvalidInputError("the original has no noise in this part; choose a flat part of a photo")
    return after / before


def flat_noise(plane: NDArray[np.floating]) -> float:
    """Standard deviation over a flat part after its best fitting paraboloid is taken off."""
    if plane.ndim != 2 or min(plane.shape) < 8:
        raise InvalidInputError(f"a flat part has at least 8 x 8 pixels, got {plane.shape}")
    rows, cols = (np.linspace(-1.0, 1.0, n) for n in plane.shape)
    y, x = np.meshgrid(rows, cols, indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    values = np.asarray(plane, dtype=np.float64).ravel()
    fit, *_ = np.linalg.lstsq(terms, values, rcond=None)
    residual = values - terms @ fit
    return float(np.sqrt(np.square(residual).sum() / (values.size - 6)))


def _same_shape(image: NDArray[np.floating], reference: NDArray[np.floating]) -> None:
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")


def _squared_error(
    image: NDArray[np.floating], reference: NDArray[np.floating], *, srgb: bool
) -> NDArray[np.float64]:
    _same_shape(image, reference)
    a = to_srgb(image) if srgb else np.asarray(image, dtype=np.float64)
    b = to_srgb(reference) if srgb else np.asarray(reference, dtype=np.float64)
    return np.square(a - b)
