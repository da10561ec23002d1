"""How the service learns lenses: the default preset, as far as the settings do not change it."""

from __future__ import annotations

from dataclasses import replace

from app.runtime.settings import Settings
from lensmodel.blind.sampling import KERNEL_PATCHES, PRESETS, Config


def configured_preset(settings: Settings) -> Config:
    """Return estimator, kernel size, patches, model mode and correction method."""
    preset = PRESETS["default"]
    own = settings.estimator != preset.estimator
    patches = settings.patches or (KERNEL_PATCHES if own else preset.patches)
    return replace(preset, estimator=settings.estimator, patches=patches)
