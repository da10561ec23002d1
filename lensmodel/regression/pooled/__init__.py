"""All patches of all photos of a lens, solved together."""

from lensmodel.regression.pooled.refine import MIN_PLACES, Pooled, pool

__all__ = ["MIN_PLACES", "Pooled", "pool"]
