"""What one patch says about its PSF, kept so that patches and photos can be pooled.

Finished kernels can only be averaged. Sufficient statistics can be summed first and solved once:
what one patch leaves open, another decides. Two kinds are kept:

* normal equations of y = k * x: the autocorrelation R of the latent patch and its cross-correlation
  r with the observed one, so that the sum of squares is k'Rk - 2 r'k + const;
* the noise-free power spectrum in rings and sectors.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import centred, resized
from lensmodel.core.spectrum import RINGS, SECTORS
from lensmodel.core.types import Kernel

_MAX_BYTES = 4 << 20
_MAX_SIDE = 255


@dataclass(frozen=True, slots=True, eq=False)
class PatchEvidence:
    """Sufficient statistics of one patch.

    Parameters
    ----------
    autocorrelation : ndarray of float32, shape (2 k - 1, 2 k - 1)
        R(d) = sum_p x(p) x(p - d) of the latent patch, noise taken off.
    crosscorrelation : ndarray of float32, shape (k, k)
        r(u) = sum_p y(p) x(p - u), noise taken off.
    pixels : int
        Number of pixels p in the sums.
    noise : float
        Standard deviation of the noise of y, in units of the patch's own range.
    spectrum : ndarray of float32, shape (RINGS, SECTORS)
        Mean power of y over rings and sectors of frequency, noise not taken off.
    spectrum_noise : float
        Power of the noise in the same units.
    """

    autocorrelation: NDArray[np.float32]
    crosscorrelation: NDArray[np.float32]
    pixels: int
    noise: float
    spectrum: NDArray[np.float32]
    spectrum_noise: float

    def __post_init__(self) -> None:
        k = self.crosscorrelation.shape[0]
        shapes_fit = (
            self.crosscorrelation.shape == (k, k)
            and self.autocorrelation.shape == (2 * k - 1, 2 * k - 1)
            and self.spectrum.shape == (RINGS, SECTORS)
        )
        if not shapes_fit or k % 2 == 0 or k > _MAX_SIDE:
            raise InvalidInputError(
                f"evidence must hold R (2k-1, 2k-1), r (k, k) with odd k <= {_MAX_SIDE} and a spectrum, got "
                f"{self.autocorrelation.shape}, {self.crosscorrelation.shape}, {self.spectrum.shape}"
            )
        for array in (self.autocorrelation, self.crosscorrelation, self.spectrum):
            if not np.isfinite(array).all():
                raise InvalidInputError("evidence must be finite; estimate the patch again")
        if self.pixels < 1 or not all(0.0 <= value < math.inf for value in (self.noise, self.spectrum_noise)):
            raise InvalidInputError(
                "evidence needs pixels, and noise that is finite and not negative, got "
                f"{self.pixels}, {self.noise} and {self.spectrum_noise}"
            )

    def to_bytes(self) -> bytes:
        """Serialise to an npz without pickle."""
        buffer = io.BytesIO()
        np.savez(
            buffer,
            autocorrelation=self.autocorrelation.astype(np.float32),
            crosscorrelation=self.crosscorrelation.astype(np.float32),
            spectrum=self.spectrum.astype(np.float32),
            scalars=np.array([self.pixels, self.noise, self.spectrum_noise], dtype=np.float64),
        )
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> PatchEvidence:
        """Read what `to_bytes` wrote.

        Raises
        ------
        InvalidInputError
            For anything else; sizes are bounded before arrays are made.
        """
        if len(data) > _MAX_BYTES:
            raise InvalidInputError(f"evidence of {len(data)} bytes is larger than {_MAX_BYTES}")
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > _MAX_BYTES:
                    raise InvalidInputError(f"evidence unpacks to more than {_MAX_BYTES} bytes")
                for entry in archive.infolist():
                    _refuse_large(archive, entry)
            with np.load(io.BytesIO(data), allow_pickle=False) as stored:
                pixels, noise, floor = (float(v) for v in stored["scalars"])
                return cls(
                    stored["autocorrelation"].astype(np.float32),
                    stored["crosscorrelation"].astype(np.float32),
                    int(pixels),
                    noise,
                    stored["spectrum"].astype(np.float32),
                    floor,
                )
        # RuntimeError: an encrypted member, or one packed by a method that zipfile does not know.
        except (
            OSError,
            ValueError,
            KeyError,
            EOFError,
            OverflowError,
            RuntimeError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise InvalidInputError("these bytes are no patch evidence") from error


def _refuse_large(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Refuse a member whose header promises more than its bytes: NumPy allocates by the header."""
    with archive.open(entry) as member:
        np.lib.format.read_magic(member)
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        raise InvalidInputError(f"evidence claims an array of shape {shape} in {entry.file_size} bytes")


def nonnegative_least_squares(
    a: NDArray[np.float64], b: NDArray[np.float64], start: NDArray[np.float64], steps: int = 200
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 by accelerated projected gradients (FISTA).

    Parameters
    ----------
    a : ndarray, shape (n, n)
        Symmetric; directions of negative curvature, which noise correction can leave, are lifted.
    b, start : ndarray, shape (n,)
        Where A is zero, nothing is known and the start is returned.
    """
    if not a.any():
        return start.copy()
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    lift = max(1e-6 * largest - float(eigenvalues[0]), 0.0)
    step = 1.0 / (largest + lift)
    k, momentum, t = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        after = np.maximum(momentum - step * (a @ momentum + lift * momentum - b), 0.0)
        t_next = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        momentum = after + (t - 1.0) / t_next * (after - k)
        k, t = after, t_next
    return k


def solve_kernel(
    evidences: Sequence[PatchEvidence], weights: Sequence[float], size: int, *, ridge: float = 2e-2
) -> Kernel:
    """Solve the pooled normal equations of several patches for one kernel.

    min over k >= 0 of  sum_i w_i (k'R_i k - 2 r_i'k) / s_i² + ridge * trace |k|²

    Parameters
    ----------
    evidences : sequence of PatchEvidence
        All of one kernel side.
    weights : sequence of float
        Votes, not negative.
    size : int
        Odd side of the result.

    Raises
    ------
    InvalidInputError
        If there is nothing to pool or the sides differ.
    """
    sides = {e.crosscorrelation.shape[0] for e in evidences}
    if len(sides) != 1 or len(weights) != len(evidences) or not any(w > 0 for w in weights):
        raise InvalidInputError(
            f"pooling needs evidence of one kernel side with positive weights, got sides {sorted(sides)} "
            f"and {len(weights)} weights"
        )
    k = sides.pop()
    correlation, cross = np.zeros((2 * k - 1, 2 * k - 1)), np.zeros((k, k))
    for evidence, weight in zip(evidences, weights, strict=True):
        vote = weight / max(evidence.noise**2, 1e-8)
        correlation += vote * evidence.autocorrelation
        cross += vote * evidence.crosscorrelation
    if not correlation.any():
        raise InvalidInputError("the pooled evidence determines no kernel")
    rows, cols = np.divmod(np.arange(k * k), k)
    a = correlation[rows[:, None] - rows + k - 1, cols[:, None] - cols + k - 1]
    a[np.diag_indices_from(a)] += ridge * np.trace(a) / a.shape[0]
    start = np.zeros(k * k)
    start[k * k // 2] = 1.0
    kernel = nonnegative_least_squares(a, cross.ravel(), start).reshape(k, k)
    if kernel.max() <= 0:
        raise InvalidInputError("the pooled evidence determines no kernel")
    kernel[kernel < 0.01 * kernel.max()] = 0.0
    return resized(centred(kernel), size)
