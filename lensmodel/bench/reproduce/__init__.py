"""The paper's figures and its Table 1, with our software, on lenses whose truth is known."""

from lensmodel.bench.reproduce.benchmark import collected
from lensmodel.bench.reproduce.cases import Case, Reproduction, Size, planned
from lensmodel.bench.reproduce.page import write_json, write_page
from lensmodel.bench.reproduce.routes import Answer, DirectRoute, OpenRoute, Place, Route
from lensmodel.bench.reproduce.run import run_reproduction

__all__ = [
    "Answer",
    "Case",
    "DirectRoute",
    "OpenRoute",
    "Place",
    "Reproduction",
    "Route",
    "Size",
    "collected",
    "planned",
    "run_reproduction",
    "write_json",
    "write_page",
]
