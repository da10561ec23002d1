"""Check what any program made of a photo: files in, verdict out.

develop both -> same light -> audit
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel import photo
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, Planes, StepHook, ignore_step
from lensmodel.correction.audit import Evidence, PhotoAudit, Window, audit_photo
from lensmodel.correction.blur import UniformBlur, crop_to_support
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto
from lensmodel.workflow.sampling import settings_of

_KERNEL: Final = 55  # pixels: the largest kernel that the paper estimates
_BLOCK: Final = 8  # pixels: means over it keep what noise hides in one (chosen)
_UNCLIPPED: Final = 0.95  # of white: above, light may be missing (chosen)
_CUT: Final = 0.25  # of the blocks, those that a rendering fits worst: edges, and what was clipped


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """A photo, what was made of it, and the verdict."""

    original: LinearPhoto  # the photo, developed
    corrected: Planes  # what was made of it, in the photo's own light
    audit: PhotoAudit  # the verdict
    reblurred: bool  # whether a profile's PSFs took part


def check(
    original: Path,
    corrected: Path,
    *,
    model: LensModel | None = None,
    settings: LensSettings | None = None,
    on_step: StepHook = ignore_step,
) -> Checked:
    """Audit a file that a program made of a photo.

    Of a RAW file the corrected one shows the light in colours of its own: the mixture of these that comes
    closest to the photo is taken. All other pairs are taken at their word.
    """
    before, after = photo.develop(original), photo.develop(corrected)
    if before.planes.shape != after.planes.shape:
        raise InvalidInputError(
            f"{original.name} has {_size(before)} pixels and {corrected.name} {_size(after)}; "
            "give the photo and what was made of it, uncropped and not turned"
        )
    planes = after.planes
    if before.info.kind in {"raw", "dng"}:
        planes = in_light_of(before, planes)
    verdict = audit_photo(before.planes, planes, _evidence(before, model, settings), on_step=on_step)
    return Checked(before, planes, verdict, model is not None)


def in_light_of(original: LinearPhoto, planes: Planes) -> Planes:
    """Mix the colours of planes so that they come closest to those of a photo: least squares over blocks.

    The quarter of the blocks that fits worst is left out, then the fit is made again.
    """
    before, after = (_means(p) for p in (original.planes, planes))
    clip = np.asarray(original.clip, dtype=np.float64)
    usable = (before < _UNCLIPPED * clip).all(axis=1) & (after < _UNCLIPPED).all(axis=1)
    if usable.sum() < 8 * len(CHANNELS):
        return planes
    before, after = before[usable], after[usable]
    # dark places count as much as bright ones
    weight = 1.0 / (before.mean(axis=1, keepdims=True) + 0.01)
    for _ in range(2):
        mixture, *_rest = np.linalg.lstsq(weight * after, weight * before, rcond=None)
        misfit = np.abs(weight * (after @ mixture - before)).sum(axis=1)
        keep = misfit <= np.quantile(misfit, 1.0 - _CUT)
        before, after, weight = before[keep], after[keep], weight[keep]
    mixed = np.einsum("ij,irc->jrc", mixture.astype(np.float32), planes, optimize=True)
    return np.ascontiguousarray(mixed, dtype=np.float32)


def _means(planes: Planes) -> NDArray[np.float64]:
    """Means of blocks, `(block, channel)`."""
    channels, rows, cols = planes.shape
    down, across = rows // _BLOCK, cols // _BLOCK
    cut = planes[:, : down * _BLOCK, : across * _BLOCK].reshape(channels, down, _BLOCK, across, _BLOCK)
    return cut.mean(axis=(2, 4), dtype=np.float64).reshape(channels, -1).T


def _evidence(
    original: LinearPhoto, model: LensModel | None, settings: LensSettings | None
) -> Callable[[FieldPosition, Window], Evidence]:
    chosen = settings_of(original, settings)
    pitch_um = original.info.metadata.pixel_pitch_um
    field = None if model is None else model.field(chosen, pitch_um=pitch_um)

    def measured(channel: int, window: Window) -> NDArray[np.bool_] | None:
        if original.cfa is None:
            return None
        rows, cols = (np.arange(part.start, part.stop) % 2 for part in window)
        return np.asarray(np.asarray(original.cfa)[rows[:, None], cols[None, :]] == channel)

    def known(position: FieldPosition, window: Window) -> Evidence:
        blurs = None
        if field is not None:
            blurs = [UniformBlur(crop_to_support(field.kernel_at(position, c, _KERNEL))) for c in CHANNELS]
        return Evidence(
            original.correction_noise,
            original.clip,
            blurs,
            (0.0, 0.0, 0.0) if field is None else [field.error_at(position, c) for c in CHANNELS],
            [measured(c, window) for c in range(3)],
        )

    return known


def _size(developed: LinearPhoto) -> str:
    return f"{developed.frame.width} x {developed.frame.height}"
