"""Synthetic lenses, cameras and scenes whose truth is known."""

from lensmodel.simulate.aberrations import Aberrations
from lensmodel.simulate.blur import BlurOptions, blurred
from lensmodel.simulate.camera import SimulatedCamera, SimulatedPhoto, Truth, photograph
from lensmodel.simulate.camera_jpeg import CAMERA_JPEGS, CameraJpeg
from lensmodel.simulate.charts import Chart, ChartEdge, edge_area, edge_chart, slanted_edge_scene
from lensmodel.simulate.draw import LENS_KINDS, draw_lens
from lensmodel.simulate.files import shot_info, write_photo
from lensmodel.simulate.lens import CameraLens, SimulatedField, SimulatedLens
from lensmodel.simulate.scenes import (
    DEMO_SCENES,
    constant,
    dead_leaves,
    demo_data_path,
    demo_scene,
    disc_kernel,
    load_scene,
    out_of_focus,
    point_lights,
    srgb_to_linear,
)

__all__ = [
    "CAMERA_JPEGS",
    "DEMO_SCENES",
    "LENS_KINDS",
    "Aberrations",
    "BlurOptions",
    "CameraJpeg",
    "CameraLens",
    "Chart",
    "ChartEdge",
    "SimulatedCamera",
    "SimulatedField",
    "SimulatedLens",
    "SimulatedPhoto",
    "Truth",
    "blurred",
    "constant",
    "dead_leaves",
    "demo_data_path",
    "demo_scene",
    "disc_kernel",
    "draw_lens",
    "edge_area",
    "edge_chart",
    "load_scene",
    "out_of_focus",
    "photograph",
    "point_lights",
    "shot_info",
    "slanted_edge_scene",
    "srgb_to_linear",
    "write_photo",
]
