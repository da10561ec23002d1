"""Light that lies over a window beside the blurred picture, and changes slowly: taken out before solving.

    y(p) = sum_u k(u) x(p - u) + sum_j c_j q_j(p) + n(p)

The c_j need not be known. What the terms q_j can explain of y and of each column x(. - u) is taken out of
both by weighted least squares; k is then the solution of what is left (R. Frisch and F. Waugh, Econometrica
1, 1933). In a window hardly wider than the kernel a quadratic takes its wings as well: there, a constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def quadratic(r: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terms 1, r, c, r², rc, c² of a smooth change of light, last axis."""
    r, c = np.broadcast_arrays(r, c)
    return np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Smooth:
    """What slow changes explain of a window and of its latent picture.

    Parameters
    ----------
    basis : ndarray, shape (H, W, n)
        Terms that are orthonormal under the weight, as single precision.
    of_y : ndarray, shape (n,)
        Their share of what was observed.
    of_x : ndarray, shape (n, k²)
        Their share of x(p - u), for each u in the order of the kernel's values.
    """

    basis: NDArray[np.float32]
    of_y: NDArray[np.float64]
    of_x: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        observed: NDArray[np.floating],
        latent: NDArray[np.floating],
        weight: NDArray[np.float64],
        size: int,
        *,
        even: bool = False,
    ) -> Smooth:
        """Project a window, shape (H, W), and its latent picture, with a margin of half a kernel.

        With `even`, on a constant alone.
        """
        height, width = weight.shape
        terms = quadratic(np.linspace(-1.0, 1.0, height)[:, None], np.linspace(-1.0, 1.0, width)[None, :])
        if even:
            terms = terms[..., :1]
        gram = np.einsum("rci,rc,rcj->ij", terms, weight, terms, optimize=True)
        # where few pixels count, what cannot be told apart is left in
        values, vectors = np.linalg.eigh(gram)
        determined = values > 1e-9 * values[-1]
        basis = terms @ (vectors[:, determined] / np.sqrt(values[determined]))
        weighted = basis * weight[..., None]
        of_x = np.empty((basis.shape[-1], size, size))
        for i in range(size):
            for j in range(size):
                part = latent[size - 1 - i : size - 1 - i + height, size - 1 - j : size - 1 - j + width]
                of_x[:, i, j] = np.einsum("rci,rc->i", weighted, part)
        return cls(
            basis=basis.astype(np.float32),
            of_y=np.einsum("rci,rc->i", weighted, np.asarray(observed, dtype=np.float64)),
            of_x=of_x.reshape(len(of_x), -1),
        )

    def out_of_y(
        self, values: NDArray[np.floating], part: tuple[NDArray[np.intp], NDArray[np.intp]]
    ) -> NDArray[np.float32]:
        """Return the residual of observed values at some pixels."""
        rest = np.asarray(values, dtype=np.float64) - self.basis[part] @ self.of_y
        return np.asarray(rest, dtype=np.float32)

    def out_of_x(
        self, rows: NDArray[np.floating], part: tuple[NDArray[np.intp], NDArray[np.intp]]
    ) -> NDArray[np.float32]:
        """Return the residual of rows of X, shape (n, k²), at some pixels."""
        return np.asarray(rows - self.basis[part] @ self.of_x.astype(np.float32), dtype=np.float32)
