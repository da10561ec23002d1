"""What a lens model says in words, numbers and pictures, and how to take it elsewhere.

Figures are drawn by `lensmodel.report.plots`, which needs matplotlib, and is imported where they are wanted.
"""

from lensmodel.report.centring import Asymmetry, Centring, centring
from lensmodel.report.comparison import Comparison, Side, compare
from lensmodel.report.export import Exporter, PsfGrid, export, exporters, format_of, psf_grid
from lensmodel.report.lens_report import (
    ApertureReport,
    Curve,
    LateralColourCurve,
    LensReport,
    SensorGeometry,
    Spot,
    Unit,
    lens_report,
    sharpness,
    widest,
)
from lensmodel.report.places import (
    Advice,
    Suggestion,
    advice,
    direction_in_words,
    little_seen,
    place_in_words,
)

__all__ = [
    "Advice",
    "ApertureReport",
    "Asymmetry",
    "Centring",
    "Comparison",
    "Curve",
    "Exporter",
    "LateralColourCurve",
    "LensReport",
    "PsfGrid",
    "SensorGeometry",
    "Side",
    "Spot",
    "Suggestion",
    "Unit",
    "advice",
    "centring",
    "compare",
    "direction_in_words",
    "export",
    "exporters",
    "format_of",
    "lens_report",
    "little_seen",
    "place_in_words",
    "psf_grid",
    "sharpness",
    "widest",
]
