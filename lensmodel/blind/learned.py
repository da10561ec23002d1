"""The default: patches of a whole photo, encoded beside each other by the network of `lensmodel.neural`.

Kernels of single patches are to be looked at, exported, and averaged by the paper's regression; the model
attends to the tokens themselves (`lensmodel.model.learned_field`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.blind.estimator import PsfEstimate, finished, usable, weight_of
from lensmodel.core import types
from lensmodel.core.psf import EncodedPatch, PatchKind, PsfSample, centred, resized, support_radius
from lensmodel.neural.network import WINDOW, FieldNetwork, conditions_of, patch_statistics, to_octant
from lensmodel.patches.select import Patch, Selection, spread_evenly
from lensmodel.photo.values import LinearPhoto

_DEVELOPED_NOISE: Final = types.NoiseModel(shot=0.0, read=1e-6)  # of developed planes in the training
_HELD: Final = 0.999  # share of its light that the array of a sample's kernel holds (chosen)
_LEAST_SIDE: Final = 15  # pixels: of a sample's kernel (chosen)
_ANYWHERE: Final = types.FieldPosition(0.5, 0.6)  # of patches of which nobody says where they lie (chosen)
_MOSAIC: Final = ((0, 1), (1, 2))  # by which developed planes are sampled


@dataclass(frozen=True, slots=True)
class LearnedEstimator:
    """Encodes the patches of whole photos; of patches without a photo it gives one kernel, as others do."""

    name: str = "default"

    @property
    def version(self) -> str:
        """Fingerprint of the weights."""
        return FieldNetwork.load().name

    def select(self, developed: LinearPhoto, *, count: int) -> Selection:
        """Choose windows all over a photo, see `spread_evenly`."""
        return spread_evenly(developed, count=count, size=WINDOW)

    def samples(
        self,
        developed: LinearPhoto,
        patches: Sequence[Patch],
        *,
        settings: types.LensSettings,
        photo: str,
        size: int,
        on_step: types.StepHook = types.ignore_step,
    ) -> list[PsfSample]:
        """Encode patches of a photo beside each other."""
        network = FieldNetwork.load()
        # only a Bayer mosaic holds the samples of the sensor
        kind: PatchKind = "jpeg" if developed.info.kind == "jpeg" else "raw" if developed.cfa else "tiff"
        conditions = conditions_of(settings, developed.info.metadata.pixel_pitch_um, kind)
        xy = np.array([patch.position.xy for patch in patches])
        rows = []
        for done, patch in enumerate(patches, start=1):
            rows.append(_statistics(developed, patch))
            on_step(done, len(patches))
        # rounded as they are stored, so that what is encoded anew from storage is the same
        statistics = to_octant(np.stack(rows), xy).astype(np.float16)
        tokens = network.encode(statistics.astype(np.float32), xy, conditions).astype(np.float16)
        samples = []
        for patch, own, token, place in zip(patches, statistics, tokens, xy, strict=True):
            encoded = EncodedPatch(own, token, kind)
            # what the network says of the place of a patch from that patch alone
            alone = network.memory(token[None].astype(np.float32), place[None], conditions)
            answer = network.query(alone, place, conditions)
            held = 2 * max(support_radius(kernel, _HELD) for kernel in answer.kernels) + 1
            side = min(max(held, _LEAST_SIDE), size, answer.kernels.shape[-1])
            for channel, kernel, error in zip(types.CHANNELS, answer.kernels, answer.error, strict=True):
                samples.append(
                    PsfSample(
                        kernel=centred(resized(kernel, side)),
                        position=patch.position,
                        settings=settings.with_channel(channel),
                        weight=weight_of(float(error)),
                        photo=photo,
                        pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                        estimator=f"{self.name}/{self.version}",
                        encoded=encoded,
                        error=min(float(error), 1.0),
                        half_diagonal_px=developed.frame.half_diagonal,
                    )
                )
        return samples

    def estimate(
        self,
        patches: Sequence[types.Plane],
        noise: Sequence[types.NoiseModel],
        *,
        size: int = 31,
        green: PsfEstimate | None = None,
    ) -> PsfEstimate:
        """Estimate the kernel that the middles of patches share, as if a whole mosaic were their plane."""
        kept = usable(patches, noise, size)
        network, conditions = FieldNetwork.load(), conditions_of(types.LensSettings(), None)
        colours = _colours(_MOSAIC, 0, 0)
        xy = np.tile(_ANYWHERE.xy, (len(kept), 1))
        rows = [
            patch_statistics(_middle(plane), colours, math.sqrt(model.read), model.shot)
            for plane, model in kept
        ]
        tokens = network.encode(to_octant(np.stack(rows), xy), xy, conditions)
        memory = network.memory(tokens, xy, conditions)
        answer = network.query(memory, xy[0], conditions)
        return finished(answer.kernels[1], size=size, error=float(answer.error[1]))


def _statistics(developed: LinearPhoto, patch: Patch) -> NDArray[np.float32]:
    """Statistics of the samples of a mosaic in a window: the sensor's, or else planes sampled by one."""
    rows, cols = slice(patch.row, patch.row + WINDOW), slice(patch.col, patch.col + WINDOW)
    planes = developed.planes[:, rows, cols]
    colours = _colours(developed.cfa or _MOSAIC, patch.row, patch.col)
    mosaic = np.take_along_axis(planes, colours[None].astype(np.intp), axis=0)[0]
    noise = developed.sensor_noise[1] if developed.cfa and developed.sensor_noise else _DEVELOPED_NOISE
    return patch_statistics(np.ascontiguousarray(mosaic), colours, math.sqrt(noise.read), noise.shot)


def _colours(pattern: Sequence[Sequence[int]], row: int, col: int) -> NDArray[np.int8]:
    """Color of each sample of a window that begins at a pixel."""
    turned = np.roll(np.asarray(pattern, dtype=np.int8), (-(row % 2), -(col % 2)), axis=(0, 1))
    return np.tile(turned, (WINDOW // 2, WINDOW // 2))


def _middle(plane: types.Plane) -> types.Plane:
    missing = [max(WINDOW - side, 0) for side in plane.shape]
    padded = np.pad(plane, [(short // 2, short - short // 2) for short in missing], "symmetric")
    top, left = ((side - WINDOW) // 2 for side in padded.shape)
    return np.ascontiguousarray(padded[top : top + WINDOW, left : left + WINDOW], dtype=np.float32)
