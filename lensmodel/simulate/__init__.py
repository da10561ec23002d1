"""Synthetic lenses, cameras and scenes whose truth is known."""

from lensmodel.simulate.camera import SimulatedCamera as SimulatedCamera
from lensmodel.simulate.camera import SimulatedPhoto as SimulatedPhoto
from lensmodel.simulate.camera import blurred as blurred
from lensmodel.simulate.camera import photograph as photograph
from lensmodel.simulate.camera import write_photo as write_photo
from lensmodel.simulate.lens import LENS_KINDS as LENS_KINDS
from lensmodel.simulate.lens import Aberrations as Aberrations
from lensmodel.simulate.lens import CameraLens as CameraLens
from lensmodel.simulate.lens import SimulatedField as SimulatedField
from lensmodel.simulate.lens import SimulatedLens as SimulatedLens
from lensmodel.simulate.lens import draw_lens as draw_lens
from lensmodel.simulate.scenes import DEMO_SCENES as DEMO_SCENES
from lensmodel.simulate.scenes import demo_data_path as demo_data_path
from lensmodel.simulate.scenes import demo_scene as demo_scene
from lensmodel.simulate.scenes import edge_chart as edge_chart
from lensmodel.simulate.scenes import load_scene as load_scene
