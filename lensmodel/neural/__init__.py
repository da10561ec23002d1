"""The learned part of the model: what a patch tells of the blur, and a regression with learned kernels.

Attention over a set of samples is Nadaraya-Watson regression [1]_ whose kernel, the weight of each sample in
the answer, is learned, as is what each sample says. `statistics` turns a patch into numbers, `network`
encodes the patches of a photo and answers at a place; `features` makes both the same in all eight octants of
the field.

References
----------
.. [1] M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, section 6, eq. 3 to 7.
"""

from lensmodel.neural.features import Conditions
from lensmodel.neural.network import FieldAnswer, FieldNetwork, Memory

__all__ = ["Conditions", "FieldAnswer", "FieldNetwork", "Memory"]
