"""Synthetic lenses, cameras and scenes whose truth is known."""

from lensmodel.simulate.camera import SimulatedCamera, SimulatedPhoto, blurred, photograph, write_photo
from lensmodel.simulate.lens import (
    LENS_KINDS,
    Aberrations,
    CameraLens,
    SimulatedField,
    SimulatedLens,
    draw_lens,
)
from lensmodel.simulate.scenes import DEMO_SCENES, demo_data_path, demo_scene, edge_chart, load_scene

__all__ = [
    "DEMO_SCENES",
    "LENS_KINDS",
    "Aberrations",
    "CameraLens",
    "SimulatedCamera",
    "SimulatedField",
    "SimulatedLens",
    "SimulatedPhoto",
    "blurred",
    "demo_data_path",
    "demo_scene",
    "draw_lens",
    "edge_chart",
    "load_scene",
    "photograph",
    "write_photo",
]
