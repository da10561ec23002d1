"""Synthetic lenses, cameras and scenes whose truth is known."""

from lensmodel.simulate.draw import LENS_KINDS, draw_lens
from lensmodel.simulate.lens import Aberrations, SimulatedField, SimulatedLens

__all__ = ["LENS_KINDS", "Aberrations", "SimulatedField", "SimulatedLens", "draw_lens"]
