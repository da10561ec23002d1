"""How the service learns lenses of each model; the settings define the default one."""

from __future__ import annotations

from dataclasses import replace

from app.runtime.settings import Settings
from lensmodel.workflow.ways import WAYS, Way


def configured_way(settings: Settings, name: str) -> Way:
    """Return the estimator, kernel size, model mode and correction method of a model.

    The settings of the service choose estimator and kernel size of the model `default`; all else is fixed.
    """
    if name != "default":
        return WAYS[name]
    return replace(WAYS[name], estimator=settings.estimator, kernel_size=settings.kernel_size)


def of_models(settings: Settings, name: str) -> dict[str, str]:
    """Return the arguments of `ModelSettings` for lenses of a model."""
    return {"mode": configured_way(settings, name).mode, "unit": settings.model_unit}
