"""What the service does with lenses of each model: the settings say it of the default one."""

from __future__ import annotations

from app.runtime.settings import Settings
from lensmodel.workflow.ways import WAYS, Way


def way_of(settings: Settings, name: str) -> Way:
    """Return how kernels are estimated for a lens of a model, what is made of them, how it corrects.

    The model `default` is what the settings of the service make of it; all others are what they are.
    """
    if name != "default":
        return WAYS[name]
    return Way(settings.estimator, settings.kernel_size, settings.model_mode, WAYS["default"].method)


def of_models(settings: Settings, name: str) -> dict[str, str]:
    """Return how such lens models are made: arguments of `ModelSettings`."""
    return {"mode": way_of(settings, name).mode, "unit": settings.model_unit}
