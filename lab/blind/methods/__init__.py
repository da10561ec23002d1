"""The blind methods of others that the paper compares with: for benchmarks, not for users.

`compared` knows them beside those of the product; `lensmodel bench blind --methods zhang,sun` runs them.
"""

from typing import Final

from lab.blind.methods.cho_lee import ChoLee
from lab.blind.methods.sun import Sun
from lab.blind.methods.xu_jia import XuJia
from lab.blind.methods.zhang import Zhang
from lensmodel.blind import PsfEstimator, estimators
from lensmodel.core.registry import Registry

compared: Final[Registry[PsfEstimator]] = estimators.extended(
    cho_lee=ChoLee, sun=Sun, xu_jia=XuJia, zhang=Zhang
)

__all__ = ["ChoLee", "Sun", "XuJia", "Zhang", "compared"]
