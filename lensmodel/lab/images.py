"""How close one picture is to another in the laboratory's figures: SSIM."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from lensmodel.core.errors import InvalidInputError
from lensmodel.quality import to_srgb

_SSIM_WINDOW: Final = 11  # pixels: that of Wang et al. 2004


def ssim(image: NDArray[np.floating], reference: NDArray[np.floating], *, srgb: bool = False) -> float:
    """Structural similarity, mean over planes; Gaussian window of sigma 1.5, range 1.

    Source: Z. Wang et al., "Image quality assessment: from error visibility to structural
    similarity", IEEE TIP 13, 2004, with its constants.
    """
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")
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
