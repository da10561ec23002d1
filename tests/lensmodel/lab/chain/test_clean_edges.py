"""Clean edges: what they show of a blur, and what is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import erf

from lensmodel.core.geometry import Frame
from lensmodel.core.psf import gaussian
from lensmodel.lab.chain.clean_edges import REACH, clean_edges, true_profile

SIDE = 160
CORE, HALO, SHARE = 1.2, 6.0, 0.3
"""Widths of two round Gaussians, pixels, and the share of the wider one."""
BETWEEN = 1.0 / 6.0
"""Mean of t (1 - t), pixels squared: what linear interpolation between two samples widens a line by."""


def within(sigma: float) -> NDArray[np.float64]:
    """Light of a Gaussian line within 1 to `REACH` pixels, in closed form."""
    return np.asarray(erf(np.arange(1, REACH + 1) / (sigma * np.sqrt(2.0))))


def expected(share: float, wider: float = 0.0) -> NDArray[np.float64]:
    """A(1) to A(`REACH`) of the two together, their variances larger by so much."""
    light = (1.0 - share) * within(np.sqrt(CORE**2 + wider)) + share * within(np.sqrt(HALO**2 + wider))
    return np.asarray(light / light[3])


def seen(share: float) -> NDArray[np.float64]:
    """Median profile of the edges of a slanted step behind that blur."""
    rows, cols = np.mgrid[:SIDE, :SIDE] - SIDE / 2.0
    scene = np.where(rows + 0.35 * cols > 3.0, 0.7, 0.2)
    core, halo = (ndimage.gaussian_filter(scene, sigma, truncate=6.0) for sigma in (CORE, HALO))
    plane = ((1.0 - share) * core + share * halo).astype(np.float32)
    edges = clean_edges(plane, Frame(SIDE, SIDE))
    assert len(edges) >= 5
    for edge in edges:
        assert edge.across == pytest.approx((0.33, 0.944), abs=0.02)
    return np.asarray(np.median([edge.profile for edge in edges], axis=0))


@pytest.mark.parametrize("share", [0.0, SHARE])
def test_an_edge_shows_how_much_light_lies_far_from_the_core(share: float) -> None:
    assert seen(share)[1:] == pytest.approx(expected(share, BETWEEN)[1:], abs=0.015)


def test_a_kernel_has_the_profile_of_the_edge_behind_it() -> None:
    halo = (1.0 - SHARE) * gaussian(63, CORE**2 * np.eye(2)) + SHARE * gaussian(63, HALO**2 * np.eye(2))

    assert true_profile(halo, (0.6, 0.8)) == pytest.approx(expected(SHARE), abs=0.03)


def test_lines_and_texture_are_no_clean_edges() -> None:
    rng = np.random.default_rng(0)
    rows, cols = np.mgrid[:SIDE, :SIDE] - SIDE / 2.0
    line = np.where(np.abs(rows + 0.35 * cols) < 2.0, 0.7, 0.2)
    texture = np.clip(0.45 + 0.3 * ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 2.0), 0.05, 0.9)

    for scene in (line, texture):
        plane = ndimage.gaussian_filter(scene, 1.0).astype(np.float32)
        assert clean_edges(plane, Frame(SIDE, SIDE)) == []
