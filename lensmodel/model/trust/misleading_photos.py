"""Photos that make a lens model worse, as the patches of the other photos say.

Photos join in the order they came in. From the third on, each is asked whether the patches of those before it
are likelier with it or without: for a patch of photo j the kernel at its place is predicted from all accepted
photos but j, once with the new one and once without, and with c the negative log likelihood of the patch
behind a kernel (`likelihood.surprise`),

    rise = c(with) - c(without)

A photo behind which patches that nobody fitted become less likely, by more than chance, does not vote: it
stays listed with its reason, and the answer is that of the photos before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import Kernel
from lensmodel.model import variables as va
from lensmodel.model.answer import ModelSettings
from lensmodel.model.field.neighbourhood import Neighbourhood
from lensmodel.model.field.robust import Flag
from lensmodel.model.field.smoothers import smoothers
from lensmodel.model.fitting import Fit
from lensmodel.model.wavefront.likelihood import surprise

_FIRST: Final = 2
"""Photos that nothing can be held against: of two that differ, nobody says which is wrong."""
_PATCHES: Final = 8  # of a photo that are asked (chosen: each costs some milliseconds)
_PHOTOS: Final = 6  # of those before that are asked, the latest (chosen, as `_PATCHES`)
_BOUND: Final = 12.0  # of what one patch says (chosen, as in `witness`: no patch speaks for all)
_SIGNIFICANT: Final = 2.0  # standard errors: one photo in forty is held wrong by chance (chosen)
_LEAST: Final = 0.5  # mean rise that matters: less is not seen in a picture (chosen)
REASON: Final = "with its kernels the patches of the other photos are less likely than without"


def without_misleading(fit: Fit, samples: Sequence[PsfSample], settings: ModelSettings) -> Fit:
    """Return a fit in which photos that make the patches of others less likely do not vote."""
    names = list(fit.roster.numbers)
    voting = {s.photo for s, vote in zip(samples, fit.validation.votes, strict=True) if vote > 0.0}
    order = [name for name in names if name in voting]
    asked = {name: _asked(samples, name) for name in order}
    if not settings.robust or len(order) <= _FIRST or not any(asked.values()):
        return fit
    accepted, flags = order[:_FIRST], []
    for name in order[_FIRST:]:
        rises = _rises(fit, samples, settings, accepted, name, asked)
        mean = float(np.mean(rises)) if len(rises) else 0.0
        error = float(np.std(rises)) / max(len(rises), 1) ** 0.5
        if mean > max(_LEAST, _SIGNIFICANT * error):
            own = fit.validation.errors[[s.photo == name for s in samples]]
            flags.append(Flag(name, None, 0.0, float(np.median(own)), REASON))
        else:
            accepted.append(name)
    if not flags:
        return fit
    left = {flag.photo for flag in flags}
    votes = fit.validation.votes * np.array([s.photo not in left for s in samples])
    kept = tuple(flag for flag in fit.validation.flags if flag.photo not in left)
    return replace(fit, validation=replace(fit.validation, votes=votes, flags=(*flags, *kept)))


def _asked(samples: Sequence[PsfSample], photo: str) -> list[int]:
    """Patches of a photo that can speak, evenly thinned."""
    own = [
        i
        for i, s in enumerate(samples)
        if s.photo == photo and s.spectrum is not None and s.settings.channel == "g"
    ]
    return [own[i] for i in np.linspace(0, len(own) - 1, min(len(own), _PATCHES)).round().astype(int)]


def _rises(
    fit: Fit,
    samples: Sequence[PsfSample],
    settings: ModelSettings,
    accepted: Sequence[str],
    name: str,
    asked: dict[str, list[int]],
) -> NDArray[np.float64]:
    """How much less likely patches of accepted photos become with a new one."""
    rises = []
    for held in accepted[-_PHOTOS:]:
        others = {one for one in accepted if one != held}
        for i in asked[held]:
            before, after = (
                _predicted(fit, samples, settings, photos, i) for photos in (others, others | {name})
            )
            if before is not None and after is not None:
                rises.append(surprise(samples[i], after) - surprise(samples[i], before))
    return np.clip(rises, -_BOUND, _BOUND)


def _predicted(
    fit: Fit, samples: Sequence[PsfSample], settings: ModelSettings, photos: set[str], index: int
) -> Kernel | None:
    """Kernel at the place of a sample, from the samples of some photos alone."""
    sample = samples[index]
    votes = fit.validation.votes * np.array([s.photo in photos for s in samples])
    if not (votes > 0.0).any():
        return None
    near = Neighbourhood(fit.index, votes, va.scales(fit.bandwidth), smoothers.create(settings.method)).near(
        [sample.position], sample.settings
    )
    widths = fit.widths.over(np.array([va.point(sample.position, sample.settings)]))
    angles, side = np.array([sample.position.phi]), sample.kernel.shape[0]
    kernels = fit.local.kernels(near, angles, widths, side, fit.validation.choice.mirror)
    kernel = np.maximum(kernels[0], 0.0)
    return np.asarray(kernel / kernel.sum())
