"""What a lens model says in words, numbers and pictures, and how to take it elsewhere.

There are more than fifteen modules because each draws, counts or writes one thing; all of them together are
one report, and none is of use to other rooms.
"""

from lensmodel.report.advice import Advice, Suggestion, advice
from lensmodel.report.decentring import Asymmetry, Decentring, decentring
from lensmodel.report.exporters import Exporter, PsfGrid, export, exporters, format_of, psf_grid
from lensmodel.report.field_shape import FieldShape
from lensmodel.report.lens_report import (
    ApertureRow,
    Curve,
    LensReport,
    MapPoint,
    ReportSettings,
    lens_report,
)
from lensmodel.report.pictures import apertures_svg, curves_svg, mtf_map_svg
from lensmodel.report.places import direction_in_words, little_seen, place_in_words

__all__ = [
    "Advice",
    "ApertureRow",
    "Asymmetry",
    "Curve",
    "Decentring",
    "Exporter",
    "FieldShape",
    "LensReport",
    "MapPoint",
    "PsfGrid",
    "ReportSettings",
    "Suggestion",
    "advice",
    "apertures_svg",
    "curves_svg",
    "decentring",
    "direction_in_words",
    "export",
    "exporters",
    "format_of",
    "lens_report",
    "little_seen",
    "mtf_map_svg",
    "place_in_words",
    "psf_grid",
]
