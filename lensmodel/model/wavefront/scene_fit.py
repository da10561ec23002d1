"""The scene of one patch, fitted behind a lens.

A few unknowns of the patch's own (`SceneView`) by Gauss and Newton, with Student's t against bins that fit
no scene; and the normal equations of the lens with those unknowns eliminated (Schur).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.scene.prior import LARGEST_RESIDUAL, PATCH_SHAPES, PATCHES, TAILS

Floats = NDArray[np.float64]

_FLOOR_RANGE = (-12.0, -1.0)  # of its logarithm: below it nothing is seen, above it no lens (chosen)
# Of Gauss and Newton: at first, and from where the last step left a scene (chosen)
_ROUNDS, _ROUNDS_AGAIN = 3, 2


@dataclass(frozen=True, slots=True, eq=False)
class SceneFit:
    """The scene of a patch behind a lens that is known.

    Parameters
    ----------
    unknowns : ndarray, shape (z,)
        See `SceneView`.
    residual, signal : ndarray, shape (BINS, c)
        What is left of the log power, and the share of the scene in the power.
    cost : float
        Of the residuals by Student's t, and of the unknowns by their prior.
    """

    unknowns: Floats
    residual: Floats
    signal: Floats
    cost: float


def fit_scene(view: SceneView, power: Floats) -> SceneFit:
    """Fit the scene of one patch behind a lens that is known.

    Parameters
    ----------
    view : SceneView
    power : ndarray, shape (BINS, c)
        |OTF|^2.

    """
    fitted = SceneState.fitted(view, power, PATCHES.bias[:, None], None)
    return SceneFit(fitted.z, fitted.residual, fitted.signal, fitted.cost)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """The scene of a patch fitted for one lens, and the linearised residuals about it."""

    z: Floats
    cost: float
    residual: Floats  # (BINS, c)
    signal: Floats  # (BINS, c): derivative of the log power by that of the scene
    kept: Floats  # (BINS, c): derivative of ln(|OTF|^2 + floor) by that of |OTF|^2
    precision: Floats  # (BINS, c, c), outliers weighted down
    weighted: Floats  # (BINS, c): precision times residual
    by_scene: Floats  # (BINS, c, z)
    normal: Floats
    gradient: Floats

    @classmethod
    def fitted(cls, view: SceneView, power: Floats, rest: Floats, begin: Floats | None) -> SceneState:
        """Solve for the patch's own unknowns by Gauss-Newton."""
        rounds = _ROUNDS_AGAIN
        if begin is None:
            rounds = _ROUNDS
            z = view.usual.copy()
            left = view.log_power - np.log(power + math.exp(z[-1])) - rest - view.shapes @ z
            z[PATCH_SHAPES.shape[1] : -1 : 3] += np.median(left, axis=0)
        else:
            z = begin
        state = cls._about(view, power, rest, z)
        for _ in range(rounds):
            z = z + np.clip(np.linalg.solve(state.normal, state.gradient), -3.0, 3.0)
            z[-1] = np.clip(z[-1], *_FLOOR_RANGE)
            state = cls._about(view, power, rest, z)
        return state

    @classmethod
    def _about(cls, view: SceneView, power: Floats, rest: Floats, z: Floats) -> SceneState:
        floor = math.exp(z[-1])
        passed = power + floor
        scene = np.exp(np.clip(view.shapes @ z + np.log(passed) + rest, -60.0, 60.0))
        signal = scene / (scene + view.noise)
        residual = np.clip(view.log_power - np.log(scene + view.noise), -LARGEST_RESIDUAL, LARGEST_RESIDUAL)
        count = residual.shape[1]
        distance = np.einsum("bi,bij,bj->b", residual, view.precision, residual)
        precision = view.precision * ((TAILS + count) / (TAILS + distance))[:, None, None]
        off = z - view.usual
        cost = float((TAILS + count) * np.log1p(distance / TAILS).sum() + view.vote @ off**2)
        by_scene = view.shapes * signal[:, :, None]
        by_scene[:, :, -1] = floor / passed * signal
        unknowns = by_scene.shape[2]
        flat = by_scene.reshape(-1, unknowns)
        weighted = np.einsum("bij,bj->bi", precision, residual)
        normal = np.einsum("bij,bjz->biz", precision, by_scene).reshape(-1, unknowns).T @ flat
        normal += np.diag(view.vote)
        gradient = flat.T @ weighted.ravel() - view.vote * off
        kept = power / passed
        return cls(z, cost, residual, signal, kept, precision, weighted, by_scene, normal, gradient)

    def reduced(self, by_lens: Floats) -> tuple[Floats, Floats, int]:
        """Normal equations of the lens and of the photo's share, the scene eliminated."""
        shared = np.broadcast_to(PATCH_SHAPES[:, None, 1:3], (*self.signal.shape, len(PATCHES.photo_spread)))
        columns = np.concatenate([by_lens * self.kept[:, :, None], shared], axis=2) * self.signal[:, :, None]
        count = columns.shape[2]
        flat = columns.reshape(-1, count)
        voted = np.einsum("bij,bjn->bin", self.precision, columns).reshape(-1, count)
        mixed = self.by_scene.reshape(flat.shape[0], -1).T @ voted
        solved = np.linalg.solve(self.normal, np.column_stack([mixed, self.gradient]))
        normal = flat.T @ voted - mixed.T @ solved[:, :-1]
        gradient = flat.T @ self.weighted.ravel() - mixed.T @ solved[:, -1]
        return normal, gradient, count
