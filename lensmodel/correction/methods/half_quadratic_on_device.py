"""Half-quadratic steps on another device; on a processor the compiled loops are quicker.

The same as `compiled.half_quadratic` within the rounding of single precision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lensmodel.correction.devices import Array, Device
from lensmodel.correction.scene_power import prior

if TYPE_CHECKING:
    from lensmodel.correction.methods.sparse_gradient import SparseProblem


def half_quadratic_on_device(
    device: Device, p: SparseProblem
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The planes and what they make of the data; see `compiled.half_quadratic.half_quadratic`."""
    xp, shape, whole, noise, variance = device.xp, (*p.y.shape[1:],), bool(p.known.all()), p.noise, p.variance
    decay, prior_power = prior((shape[0], shape[1]))
    data, mask, transfer, zero = (device.send(a) for a in (p.y, p.known, p.K, np.zeros_like(p.y)))
    smoothness, scales, turn = (device.send(a) for a in (p.smooth, p.scale, p.rotation))
    levels = np.maximum(variance - noise, np.float32(0.005) * variance + np.float32(1e-12))

    def forward(planes: Array) -> Array:
        return xp.fft.rfftn(planes, axes=(-2, -1))

    def back(spectra: Array) -> Array:
        return xp.fft.irfftn(spectra, s=shape, axes=(-2, -1))

    def turned(planes: Array, matrix: Array) -> Array:
        return xp.reshape(xp.matmul(matrix, xp.reshape(planes, (planes.shape[0], -1))), planes.shape)

    def pull_of(x: Array, step: int) -> Array:
        """sum_j F_j^T prox(F_j x), periodic forward differences."""
        factor, total = device.send(p.factors[step][:, None, None]), None
        for axis in (-2, -1):
            slopes = turned(xp.roll(x, -1, axis=axis) - x, turn)
            kept = turned(p.prox.shrunk(xp, slopes, scales * factor), xp.matrix_transpose(turn))
            pull = xp.roll(kept, 1, axis=axis) - kept
            total = pull if total is None else total + pull
        return total

    power = xp.real(transfer) ** 2 + xp.imag(transfer) ** 2
    conjugate, Y = xp.conj(transfer), forward(data)
    passed = device.fetch(xp.sum(device.send(prior_power) * power, axis=(-2, -1)))
    ratio = device.send((noise * passed / (levels * (shape[0] * shape[1]))).astype(np.float32)[:, None, None])
    X = Y * conjugate / (power + ratio * device.send(decay) + 1e-9)
    X[:, 0, 0] = Y[:, 0, 0] * conjugate[:, 0, 0]
    x, change = back(X), None

    def blurred() -> Array:
        return transfer * X if change is None else transfer * X + change

    for step, coupling in enumerate(p.couplings):
        pull = pull_of(x, step)
        if p.drift.size and p.turns[step]:
            rates = device.send(p.drift)
            moved = forward(x * device.send(p.down[:, None])), forward(x * device.send(p.across[None, :]))
            change = rates[:, 0, ...] * moved[0] + rates[:, 1, ...] * moved[1]
        weight = device.send((coupling * noise)[:, None, None])
        if not whole:
            Y = blurred() + forward(xp.where(mask, data - back(blurred()), zero))
        fit = conjugate * (Y if change is None else Y - change)
        X = (fit + weight * forward(pull)) / (power + weight * smoothness)
        x = back(X)
    X = forward(x) if whole else X
    return device.fetch(x), device.fetch(back(blurred()))
