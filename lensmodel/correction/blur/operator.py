"""What every blur operator offers, and how far a kernel reaches."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Kernel, Plane


class BlurOperator(Protocol):
    """Linear blur y = F x: a latent plane, wider than the frame, onto the frame.

    Light from outside the frame is in the data, so the latent plane reaches beyond it.
    """

    def forward(self, latent: Plane) -> Plane:
        """Return F x.

        Parameters
        ----------
        latent : Plane, shape (h + 2 m, w + 2 m), float32
            Wider than the frame by the reach m of the blur.

        Returns
        -------
        Plane, shape (h, w), float32
        """

    def adjoint(self, blurred: Plane) -> Plane:
        """Return F^T y.

        Parameters
        ----------
        blurred : Plane, shape (h, w), float32

        Returns
        -------
        Plane, shape (h + 2 m, w + 2 m), float32
        """

    def frame(self, latent: Plane) -> Plane:
        """Return the part of the latent plane that the photo shows.

        Parameters
        ----------
        latent : Plane, shape (h + 2 m, w + 2 m)

        Returns
        -------
        Plane, shape (h, w)
        """


def support_radius(kernel: Kernel, energy: float = 0.999) -> int:
    """Half side, in pixels, of the centred square that holds `energy` of the kernel's sum.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
    energy : float
        Share in 0..1.

    Returns
    -------
    int
    """
    middle = kernel.shape[0] // 2
    t = np.abs(np.arange(kernel.shape[0]) - middle)
    ring = np.maximum(t[:, None], t[None, :])
    held = np.cumsum(np.bincount(ring.ravel(), weights=kernel.ravel()))
    return int(np.searchsorted(held, energy * held[-1]))


def crop_to_support(kernel: Kernel, energy: float = 0.999) -> Kernel:
    """Cut a kernel to its support; the middle pixel stays the middle, the sum is 1 again.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
    energy : float
        Share of the sum that the support holds, 0..1.

    Returns
    -------
    Kernel, shape (s, s)
        s odd, at most k.
    """
    middle, radius = kernel.shape[0] // 2, support_radius(kernel, energy)
    return as_kernel(kernel[middle - radius : middle + radius + 1, middle - radius : middle + radius + 1])
