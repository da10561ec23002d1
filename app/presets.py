"""How the service learns lenses of each model; the settings define the default one."""

from __future__ import annotations

from dataclasses import replace

from app.runtime.settings import Settings
from lensmodel.workflow.sampling import KERNEL_PATCHES, PRESETS, Preset


def configured_preset(settings: Settings, name: str) -> Preset:
    """Return estimator, kernel size, patches, model mode and correction method of a model."""
    # The settings of the service choose the estimator of the model `default`, and the patches of both
    preset = PRESETS[name]
    if name == "default":
        own = settings.estimator != preset.estimator
        patches = KERNEL_PATCHES if own else preset.patches
        preset = replace(preset, estimator=settings.estimator, patches=patches)
    return replace(preset, patches=settings.patches or preset.patches)
