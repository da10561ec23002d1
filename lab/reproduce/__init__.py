"""The paper's figures and its Table 1, with our software, on lenses whose truth is known.

There are more than fifteen modules because each figure, kind of lens and step of the experiment has one.
"""

from lab.reproduce.cases import Case, Reproduction, Size
from lab.reproduce.pages.bars import missed
from lab.reproduce.pages.blind_curve import collected
from lab.reproduce.pages.page import write_json, write_page
from lab.reproduce.planning import planned
from lab.reproduce.routes import Answer, CorrectedPhoto, DirectRoute, OpenRoute, Place, Route
from lab.reproduce.run import run_reproduction

__all__ = [
    "Answer",
    "Case",
    "CorrectedPhoto",
    "DirectRoute",
    "OpenRoute",
    "Place",
    "Reproduction",
    "Route",
    "Size",
    "collected",
    "missed",
    "planned",
    "run_reproduction",
    "write_json",
    "write_page",
]
