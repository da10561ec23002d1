"""The network: `statistics` turns a patch into numbers, `network` encodes the patches of a photo and answers.

Both are the same in all eight octants of the field. `lensmodel.blind.learned` takes the patches
from photos, and `lensmodel.model.learned_field` asks of those of all photos; `lab.population` trains it.
"""

from lensmodel.neural.network import RING_MIDDLES, FieldAnswer, FieldNetwork, Memory, conditions_of

__all__ = ["RING_MIDDLES", "FieldAnswer", "FieldNetwork", "Memory", "conditions_of"]
