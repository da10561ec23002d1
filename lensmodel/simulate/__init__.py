"""Synthetic lenses, cameras and scenes whose truth is known."""

from lensmodel.simulate.camera import (
    BlurOptions,
    SimulatedCamera,
    SimulatedPhoto,
    blurred,
    photograph,
    write_photo,
)
from lensmodel.simulate.draw import LENS_KINDS, draw_lens
from lensmodel.simulate.lens import Aberrations, CameraLens, SimulatedField, SimulatedLens
from lensmodel.simulate.scenes import (
    DEMO_SCENES,
    Chart,
    ChartEdge,
    demo_data_path,
    demo_scene,
    edge_chart,
    load_scene,
    slanted_edge_scene,
    srgb_to_linear,
)

__all__ = [
    "DEMO_SCENES",
    "LENS_KINDS",
    "Aberrations",
    "BlurOptions",
    "CameraLens",
    "Chart",
    "ChartEdge",
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
    "slanted_edge_scene",
    "srgb_to_linear",
    "write_photo",
]
