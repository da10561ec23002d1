"""What stands behind an answer: expected error, standard error, distance to the samples."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lensmodel.regression import variables as va
from lensmodel.regression.canonical import CanonicalGrid

_FAR = 2.5


def field_error(
    held_out: float,
    rows: NDArray[np.float32],
    mean: NDArray[np.floating],
    weight: NDArray[np.float64],
    independent: float,
) -> float:
    """Expected relative L2 of the mean, from held-out errors that contain the samples' own noise.

    With m independent photos, bias b and noise s of a sample::

        held out:  e^2 = b^2 + s^2 (1 + 1/m)        field:  b^2 + s^2 / m

    s is taken from the scatter of the neighbours, which also differ in place; so b is not
    taken below a third of e.
    """
    apart = rows - mean
    norms = np.einsum("ij,ij->i", apart, apart)
    power = max(float(mean @ mean), 1e-30)
    scatter = float(weight @ norms) / power
    noise = min(scatter / max(1.0 - float(weight @ weight), 0.1), held_out)
    bias = max(held_out - noise * (1.0 + 1.0 / independent), held_out / 9.0)
    return math.sqrt(bias + noise / independent)


def support(
    where: NDArray[np.float64], asked: NDArray[np.float64], rule: Mapping[str, float]
) -> tuple[float, tuple[str, ...]]:
    """Distance to the nearest of samples `where` (m, 7), and the variables in which all are far.

    Distances count in bandwidths of eq. (8), `rule` from `variables.bandwidths`.
    """
    gaps = np.nan_to_num((where - asked) / va.scales(va.support(rule)), nan=0.0)
    squared = gaps**2
    nearest = int(squared.sum(axis=1).argmin())
    beyond = {name for name, value in zip(va.COLUMNS, np.abs(gaps).min(axis=0), strict=True) if value > _FAR}
    distance = math.sqrt(float(squared[nearest].sum()))
    if not beyond and distance > _FAR:
        beyond = {va.COLUMNS[int(squared[nearest].argmax())]}
    return distance, tuple(sorted(beyond))


def standard_error(
    grid: CanonicalGrid,
    rows: NDArray[np.float32],
    weight: NDArray[np.float64],
    phi: float,
    width: tuple[float, float],
    size: int,
) -> NDArray[np.float64]:
    """Standard error of each pixel, sqrt(sum w^2 sum w (C - f)^2 / (1 - sum w^2))."""
    mean = weight.astype(np.float32) @ rows
    concentration = float((weight**2).sum())
    if concentration > 1.0 - 1e-9:
        return np.full((size, size), np.nan)  # a single sample says nothing of its own scatter
    kernels = [grid.sampled(row - mean, phi, width, size) for row in rows]
    scatter = sum(w * k * k for w, k in zip(weight, kernels, strict=True))
    return np.asarray(np.sqrt(scatter * concentration / (1.0 - concentration)), dtype=np.float64)
