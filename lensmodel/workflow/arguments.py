"""Arguments of the library, checked at the door."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError


def places_joined(r: ArrayLike, phi: ArrayLike) -> Sequence[NDArray[np.float64]]:
    """Broadcast the two numbers of field positions to arrays of one shape.

    Raises
    ------
    InvalidInputError
        If their shapes do not broadcast.
    """
    radii, angles = np.asarray(r, dtype=np.float64), np.asarray(phi, dtype=np.float64)
    try:
        return np.broadcast_arrays(radii, angles)
    except ValueError as error:
        raise InvalidInputError(
            f"r and phi must have shapes that broadcast, got {radii.shape} and {angles.shape}"
        ) from error


def frequencies_of(values: ArrayLike) -> NDArray[np.float64]:
    """Return frequencies in cycles/pixel, shape (n,); one number is a list of one.

    Raises
    ------
    InvalidInputError
        If they are no list, or one is negative or not finite.
    """
    wanted = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if wanted.ndim != 1:
        raise InvalidInputError(f"frequencies must have the shape (n,), got {wanted.shape}; give a flat list")
    wrong = wanted[~(np.isfinite(wanted) & (wanted >= 0.0))]
    if wrong.size:
        raise InvalidInputError(
            f"frequencies must be finite and not negative, in cycles/pixel, got {wrong[0]:g}; leave it out"
        )
    return wanted


def one_each(values: ArrayLike, n: int, name: str) -> list[float]:
    """Return n numbers that were given one by one, or once for all.

    Raises
    ------
    InvalidInputError
        If there are other than one or n.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in {(), (n,)}:
        raise InvalidInputError(f"{name} must be one number or {n}, one for each kernel, got {array.shape}")
    return [float(value) for value in np.broadcast_to(array, (n,))]


def named_each(values: str | Sequence[str], n: int, name: str) -> list[Any]:
    """Return n names that were given one by one, or once for all.

    Raises
    ------
    InvalidInputError
        If there are other than one or n.
    """
    names = [values] * n if isinstance(values, str) else list(values)
    if len(names) != n:
        raise InvalidInputError(f"{name} must be one or {n}, one for each kernel, got {len(names)}")
    return names


def require_workers(workers: int | None) -> None:
    """Refuse a number of workers that does no work; None stands for all cores.

    Raises
    ------
    InvalidInputError
        If it is below 1.
    """
    if workers is not None and workers < 1:
        raise InvalidInputError(f"workers must be at least 1, got {workers}; None takes all cores")
