"""What a lens model says in words, numbers and pictures, and how to take it elsewhere.

Figures are drawn by `lensmodel.report.plots`, which needs matplotlib, and is imported where they are wanted.
"""

from lensmodel.report.centring import Asymmetry, Centring, centring
from lensmodel.report.export import PsfGrid, export, exporters, psf_grid
from lensmodel.report.lens_report import (
    ApertureReport,
    Comparison,
    Curve,
    LateralColourCurve,
    LensReport,
    SensorGeometry,
    Spot,
    Unit,
    caution,
    compare,
    filled_aspect,
    lens_report,
    provenance,
    sharpness,
    widest,
)
from lensmodel.report.places import direction_in_words, place_in_words

__all__ = [
    "ApertureReport",
    "Asymmetry",
    "Centring",
    "Comparison",
    "Curve",
    "LateralColourCurve",
    "LensReport",
    "PsfGrid",
    "SensorGeometry",
    "Spot",
    "Unit",
    "caution",
    "centring",
    "compare",
    "direction_in_words",
    "export",
    "exporters",
    "filled_aspect",
    "lens_report",
    "place_in_words",
    "provenance",
    "psf_grid",
    "sharpness",
    "widest",
]
