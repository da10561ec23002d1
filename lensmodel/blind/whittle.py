"""Whittle-likelihood Gaussian: the spectrum of a patch as a power law times a Gaussian MTF."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from scipy import fft, optimize

from lensmodel.blind.base import PsfEstimate
from lensmodel.errors import NotEnoughEvidenceError
from lensmodel.psf import gaussian, resized
from lensmodel.types import NoiseModel, Plane, StepHook, ignore_step


class Whittle:
    """Gaussian PSF by maximum Whittle likelihood of the windowed periodogram."""

    name: ClassVar[str] = "whittle"
    version: ClassVar[int] = 0

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share."""
        start = time.process_time()
        n = 64
        window = np.outer(np.hanning(n), np.hanning(n))
        f0, f1 = np.meshgrid(fft.fftfreq(n), fft.rfftfreq(n), indexing="ij")
        f = np.hypot(f0, f1)
        use = (f > 0.05) & (f <= 0.5)
        spectra, floors = [], []
        for patch, model in zip(patches, noise, strict=True):
            level = float(patch.mean())
            sigma = model.sigma_at(level)
            if not np.isfinite(patch).all() or patch.std() < 3 * sigma:
                continue
            tiles = [
                np.abs(fft.rfft2((t - t.mean()) * window)) ** 2
                for r in range(0, patch.shape[0] - n + 1, n // 2)
                for c in range(0, patch.shape[1] - n + 1, n // 2)
                for t in [patch[r : r + n, c : c + n].astype(np.float64)]
            ]
            scale = float(np.mean(patch.astype(np.float64) ** 2))
            spectra.append(np.mean(tiles, axis=0)[use] / scale)
            floors.append(sigma**2 * (window**2).sum() / scale)
        if not spectra:
            raise NotEnoughEvidenceError(
                "the patches are too flat for their noise; choose parts with more detail"
            )
        freq, angle = f[use], np.arctan2(f0[use], f1[use])
        a0, a1 = f0[use], f1[use]

        def cost(p: np.ndarray) -> float:
            l00, l10, l11 = p[:3]
            c00, c01, c11 = l00**2, l00 * l10, l10**2 + l11**2
            mtf2 = np.exp(-4 * np.pi**2 * (c00 * a0**2 + 2 * c01 * a0 * a1 + c11 * a1**2))
            total = 0.0
            for i, (s, floor) in enumerate(zip(spectra, floors, strict=True)):
                amp, b, e1, e2 = p[3 + 4 * i : 7 + 4 * i]
                m = (
                    np.exp(amp - b * np.log(freq / 0.1) + e1 * np.cos(2 * angle) + e2 * np.sin(2 * angle))
                    * mtf2
                    + floor
                )
                total += (
                    float(np.mean(np.log(m) + s / m)) + ((b - 2.1) / 0.25) ** 2 / 400 + (e1**2 + e2**2) / 200
                )
            return total

        best = None
        for width in (0.7, 1.5, 3.0):
            x0 = [width, 0.0, width]
            for s in spectra:
                x0 += [float(np.log(np.median(s) + 1e-12)), 2.1, 0.0, 0.0]
            found = optimize.minimize(cost, x0, method="L-BFGS-B", options={"maxiter": 80})
            if best is None or found.fun < best.fun:
                best = found
        l00, l10, l11 = best.x[:3]
        covariance = np.array([[l00**2, l00 * l10], [l00 * l10, l10**2 + l11**2]])
        kernel = resized(gaussian(max(size, 3), covariance), size)
        on_step(1, 1)
        return PsfEstimate(
            kernel=kernel,
            confidence=0.5,
            reliability=np.ones(16),
            predicted_error=0.5,
            diagnostics={"width": float(np.sqrt(np.trace(covariance) / 2))},
            seconds=time.process_time() - start,
        )

    def estimate_channel(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        reference: PsfEstimate,
        reference_patches: Sequence[Plane],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate another channel of the same patches."""
        return self.estimate(patches, noise, size=size, rng=rng, on_step=on_step)
