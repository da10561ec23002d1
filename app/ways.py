"""How the service learns lenses of each model; the settings define the default one."""

from __future__ import annotations

from app.runtime.settings import Settings
from lensmodel.workflow.ways import WAYS, Way


def way_of(settings: Settings, name: str) -> Way:
    """Return the estimator, kernel size, model mode and correction method of a model.

    The settings of the service define the model `default`; all others are fixed.
    """
    if name != "default":
        return WAYS[name]
    return Way(settings.estimator, settings.kernel_size, settings.model_mode, WAYS["default"].method)


def of_models(settings: Settings, name: str) -> dict[str, str]:
    """Return the arguments of `ModelSettings` for lenses of a model."""
    return {"mode": way_of(settings, name).mode, "unit": settings.model_unit}
