"""A basis of lens PSFs over the whole field, by principal components of simulated lenses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.model.exact import pixel_to_local
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, centred, resized
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.simulate import draw_lens

STORED: Final = Path(__file__).parent.parent / "data" / "rival_basis.npz"

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RadialBasis:
    """Fields f(r; u, v) = mean + sum_k c_k b_k, on a few radii, linear between them."""

    radii: Floats  # (J,), ascending, from 0 to 1
    mean: Floats  # (J, K, K), in the local frame: columns grow along u, rows against v
    # (m, J, K, K), principal components times their standard deviation, so that a usual lens has c_k around 1
    parts: Floats

    @property
    def side(self) -> int:
        """K."""
        return int(self.mean.shape[-1])

    def turned(self, position: FieldPosition) -> Floats:
        """Mean and components at a place in the image frame, shape (1 + m, K, K)."""
        upper = min(max(int(np.searchsorted(self.radii, position.r)), 1), len(self.radii) - 1)
        low, high = self.radii[upper - 1], self.radii[upper]
        share = min(max((position.r - low) / (high - low), 0.0), 1.0)
        every = np.concatenate([self.mean[None], self.parts])
        local = (1.0 - share) * every[:, upper - 1] + share * every[:, upper]
        half = self.side // 2
        t = np.arange(-half, half + 1, dtype=np.float64)
        u, v = pixel_to_local(t[:, None], t[None, :], position.phi)
        points = np.stack(np.broadcast_arrays(half - v, half + u))
        turn = partial(ndimage.map_coordinates, coordinates=points, order=3, mode="grid-constant")
        return np.stack([turn(one) for one in local])


def principal(fields: NDArray[np.floating], radii: Sequence[float], count: int) -> RadialBasis:
    """Take the principal components of fields."""
    both = np.concatenate([fields, fields[:, :, ::-1]]).astype(np.float64)
    if len(both) < count:
        raise InvalidInputError(f"{count} components need as many fields, got {len(both)} with their mirrors")
    flat = both.reshape(len(both), -1)
    mean = flat.mean(axis=0)
    _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
    scale = sizes[:count] / math.sqrt(len(flat))
    shape = fields.shape[1:]
    parts = (scale[:, None] * directions[:count]).reshape(count, *shape)
    return RadialBasis(np.asarray(radii, dtype=np.float64), mean.reshape(shape), parts)


def save_basis(basis: RadialBasis, path: Path) -> None:
    """Write a basis as npz, each component scaled into half precision."""
    scale = np.abs(basis.parts).max(axis=(1, 2, 3))
    np.savez_compressed(
        path,
        radii=basis.radii,
        mean=basis.mean.astype(np.float32),
        parts=(basis.parts / scale[:, None, None, None]).astype(np.float16),
        scale=scale,
    )


@lru_cache(maxsize=2)
def load_basis(path: Path = STORED) -> RadialBasis:
    """Read what `save_basis` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        parts = stored["parts"].astype(np.float64) * stored["scale"][:, None, None, None]
        return RadialBasis(stored["radii"], stored["mean"].astype(np.float64), parts)


@dataclass(frozen=True, slots=True, eq=False)
class BasisField:
    """A field of the basis; coefficients may change with the angle, c(phi) = c0 + a cos + b sin."""

    basis: RadialBasis
    coefficients: dict[Channel, Floats]  # (m, 3), c0, a, b

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; see `PsfField`."""
        every = self.basis.turned(position)
        return resized(composed(every, self.coefficients[channel] @ harmonics(position.phi)), size)


def harmonics(phi: float) -> Floats:
    """1, cos phi, sin phi."""
    return np.array([1.0, math.cos(phi), math.sin(phi)])


def composed(every: Floats, coefficients: Floats) -> Kernel:
    """Mean plus components; negative values are cut, and the centre of mass moved to the middle."""
    light = np.maximum(every[0] + np.tensordot(coefficients, every[1:], axes=1), 0.0)
    light[light < 1e-3 * light.max()] = 0.0
    return centred(as_kernel(light))


SEEDS: Final = range(100)  # those of development
RADII: Final = (0.0, 0.25, 0.5, 0.7, 0.85, 1.0)  # half diagonals (chosen): denser outwards
QUARTERS: Final = (0, 1, 2, 3)
"""Directions of the field in quarter turns: only these take a kernel to the local frame exactly."""

SIDE: Final = 31  # pixels of a kernel: that of an estimate
COMPONENTS: Final = 32  # kept in the basis (chosen)
_STOPS: Final = (1.0, math.sqrt(2.0))  # factors on the f-number (chosen): wide open, and one stop closed


def main() -> None:
    """Draw the lenses, take their kernels in the local frame, and store the principal components."""
    fields = []
    for seed in SEEDS:
        lens = draw_lens(seed)
        for stop in _STOPS:
            settings = LensSettings(aperture=lens.optics[0].f_number * stop, focal_mm=lens.focal_mm[0])
            for quarter in QUARTERS:
                places = [FieldPosition(r, quarter * math.pi / 2.0) for r in RADII]
                kernels = [lens.kernel(place, settings, SIDE) for place in places]
                fields.append([np.rot90(kernel, -quarter) for kernel in kernels])
    save_basis(principal(np.array(fields), RADII, COMPONENTS), STORED)


if __name__ == "__main__":
    main()
