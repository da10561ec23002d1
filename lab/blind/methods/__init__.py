"""The blind methods of others that the paper compares with: for benchmarks, not for users."""

from collections.abc import Sequence
from typing import Final, Protocol

from lab.blind.methods.cho_lee import ChoLee
from lab.blind.methods.sun import Sun
from lab.blind.methods.xu_jia import XuJia
from lab.blind.methods.zhang import Zhang
from lensmodel.blind import PsfEstimate, estimators
from lensmodel.core.registry import Registry
from lensmodel.core.types import NoiseModel, Plane


class BlindMethod(Protocol):
    """What the benchmark asks of an estimator."""

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        """Estimate the kernel of odd side `size` that all patches share; those here take one patch."""


compared: Final[Registry[BlindMethod]] = Registry(
    "estimator", {**estimators, "cho-lee": ChoLee, "sun": Sun, "xu-jia": XuJia, "zhang": Zhang}
)

__all__ = ["BlindMethod", "ChoLee", "Sun", "XuJia", "Zhang", "compared"]
