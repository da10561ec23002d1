"""The scene of one patch behind a lens that is known."""

from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.spectrum import RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import CHANNELS
from lensmodel.model.wavefront.scene_fit import SceneState
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.optics.transfer import BINS
from lensmodel.scene.prior import PATCHES


@pytest.mark.parametrize("seed", range(6))
def test_a_fit_goes_on_from_any_scene_and_never_uphill(seed: int) -> None:
    """Stripes, deep zeros and begins far off: what Gauss and Newton alone overshoot."""
    rng = np.random.default_rng(seed)
    spectra = {
        c: PatchSpectrum(np.exp(rng.normal(-6.0, 2.0, (RINGS, SECTORS))).astype(np.float32), 1e-5)
        for c in CHANNELS
    }
    view = SceneView.of(spectra)
    power = np.exp(rng.uniform(-12.0, 0.0, (BINS, 3)))
    rest = PATCHES.bias[:, None]
    z = view.usual + rng.normal(0.0, 1.5, view.usual.size)
    z[-1] = -6.0
    cost = SceneState._about(view, power, rest, z).cost

    for _ in range(6):
        state = SceneState.fitted(view, power, rest, z)
        assert state.cost <= cost
        cost, z = state.cost, state.z
