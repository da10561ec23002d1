"""PSFs measured on photos made for it, instead of estimated from ordinary ones.

There are more than fifteen modules because the four ways (points, edges, a target, a pair of apertures) share
windows, light, warps and the solver, one step to a module.
"""

from lensmodel.estimation.measure.catalogue import methods
from lensmodel.estimation.measure.measurer import MeasuredPsf, Measurer, estimator_of, is_measured, samples_of
from lensmodel.estimation.measure.page import DETAILS, TargetPage
from lensmodel.estimation.measure.printing import PAPERS, print_target

__all__ = [
    "DETAILS",
    "PAPERS",
    "MeasuredPsf",
    "Measurer",
    "TargetPage",
    "estimator_of",
    "is_measured",
    "methods",
    "print_target",
    "samples_of",
]
