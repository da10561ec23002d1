"""PSF fields to compare with: a general profile, a measured lens, and the ways of Fig. 2."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from lab import targets
from lab.correction.filter_flow import EfficientFilterFlow
from lab.kernels import distance
from lab.model_benchmark import PATCHES, asked_places, patch_places, predictor
from lab.reproduce.cases import Case
from lensmodel import measured as measure
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.psf import PsfField, PsfSample, as_kernel
from lensmodel.core.types import ZONES, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.measured.target import Target
from lensmodel.model import LensModel
from lensmodel.photo import develop
from lensmodel.simulate import LENS_KINDS, SimulatedField, draw_lens, photograph, write_photo

SIZE: Final = 31
"""Side of the kernels that are measured or interpolated, that of the blind estimates."""

COPIES: Final = 6
"""Lenses that a profile of a third-order lens is the mean of (chosen: a maker measures a few)."""

EFF: Final = "efficient filter flow"
REGRESSIONS: Final = {"the paper's regression": "paper", "regression of today's default": "mode-default"}
FRAME: Final = Frame(288, 432)
"""Of the flow. Weights depend on the place in the field alone: a small frame is as good as a large one."""

# Of the photo of the target (chosen): share of the frame, factor on the light, seed beside that of the case.
_FILL: Final = 0.97
_EXPOSURE: Final = 0.8
_SEED: Final = 77

Predictor = Callable[[FieldPosition], Kernel]


# --- a general profile of the lens model: what a maker of software has who measured other copies ---


@dataclass(frozen=True, slots=True, eq=False)
class MeanField:
    """Mean of several PSF fields: kernels of one place, centred each, averaged pixel by pixel."""

    fields: Sequence[PsfField]

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of a place; see `PsfField`."""
        kernels = [field.kernel_at(position, channel, size) for field in self.fields]
        return as_kernel(np.mean(kernels, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class SymmetricField:
    """A PSF field without what makes a copy uneven: its mean over quarter turns and their mirror images.

    With R the turn of a kernel by 90 degrees towards growing phi, and M the mirror image upside down::

        g(r, phi) = 1/8 sum_k ( R^-k f(r, phi + 90 k) + M R^-k f(r, -phi + 90 k) ),    k = 0..3
    """

    field: PsfField

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of a place; see `PsfField`."""
        kernels = []
        for turns in range(4):
            for mirrored in (False, True):
                phi = -position.phi if mirrored else position.phi
                place = FieldPosition(position.r, phi + turns * math.pi / 2.0)
                upright = np.rot90(self.field.kernel_at(place, channel, size), -turns)
                kernels.append(upright[::-1] if mirrored else upright)
        return as_kernel(np.mean(kernels, axis=0))


def general_words(case: Case) -> str:
    """Say what the general profile of a case is made of."""
    return f"mean of {COPIES} lenses of its kind" if case.grid is None else "the lens itself made symmetric"


def general_field(case: Case) -> PsfField:
    """Return what is known of the lens of a case without any photo of it, see `general_words`."""
    if case.grid is not None:
        return SymmetricField(case.truth())
    kind = case.seed % len(LENS_KINDS)
    fields = []
    for lens in (draw_lens(kind + len(LENS_KINDS) * i) for i in range(COPIES)):
        focal = lens.focal_mm[0]
        settings = LensSettings(aperture=lens.widest(focal), focal_mm=focal)
        fields.append(SimulatedField(lens, settings, case.camera.pitch_um))
    return MeanField(fields)


# --- the non-blind row of Table 1: the lens measured with a printed target, by a photo like the others ---


def measured_field(case: Case, path: Path) -> PsfField:
    """Photograph the printed target through the lens, measure it, and return the model of what was found."""
    page = measure.TargetPage(round(_FILL * case.height * 2**0.5))  # as many samples as it takes pixels
    scene = targets.target_scene(page, (case.height, case.width), targets.Setup(fill=_FILL))
    rng = np.random.default_rng([case.seed, _SEED])
    write_photo(path, photograph(scene, case.lens, case.settings, case.camera, rng, exposure=_EXPOSURE))
    photo, method = develop(path), Target(details=(page.detail,))
    found = method.measure([photo], size=SIZE)
    samples = measure.samples_of(found, method, photo, photo_id="target", settings=case.settings)
    return LensModel.fit(samples).field(case.settings, pitch_um=case.camera.pitch_um)


# --- Fig. 2: what efficient filter flow applies between its PSFs, beside regressions, fed with true PSFs ---
# The flow's PSFs stand on a regular grid of 4 x 6 windows with half overlap and Bartlett-Hann slopes, as the
# paper has it; the regressions see as many, one at a random place of each window.


class Flow:
    """The PSF that efficient filter flow applies at a place, from the PSFs at the centres of its windows."""

    def __init__(self, field: PsfField, frame: Frame = FRAME, size: int = SIZE) -> None:
        self._frame, self._size = frame, size
        pitch = round(frame.height / PATCHES[0])
        self._flow = EfficientFilterFlow.of_field(field, frame, "g", pitch=pitch, size=size)

    def __call__(self, place: FieldPosition) -> Kernel:
        """Blur a point of light at the pixel that is nearest to a place, and cut out what becomes of it."""
        row, col = (round(x) for x in self._frame.pixel(place))
        reach = self._size // 2
        latent = np.zeros(self._flow.latent_shape, dtype=np.float32)
        latent[row + reach, col + reach] = 1.0
        answer = np.pad(self._flow.forward(latent), reach)
        return as_kernel(np.maximum(answer[row : row + self._size, col : col + self._size], 0.0))


def predictors(case: Case) -> dict[str, Predictor]:
    """Ways to answer between the true PSFs of a lens, by name."""
    truth, settings = case.truth(), LensSettings(aperture=case.aperture, channel="g")
    places = patch_places(np.random.default_rng(case.seed))
    samples = [PsfSample(truth.kernel_at(p, "g", SIZE), p, settings, photo="photo0") for p in places]
    return {EFF: Flow(truth), **{name: predictor(way, samples) for name, way in REGRESSIONS.items()}}


def compared(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Mean relative L2 by zone of each way, over lenses: rows of `method` and `errors`."""
    collected: dict[str, dict[str, list[float]]] = {}
    for case in cases:
        truth = case.truth()
        for name, predict in predictors(case).items():
            errors = collected.setdefault(name, {zone: [] for zone in ZONES})
            for place in _inside(asked_places()):
                error = distance(predict(place), truth.kernel_at(place, "g", SIZE)).rel_l2
                errors[zone_of(place.r)].append(error)
    return [
        {"method": name, "errors": {zone: float(np.mean(v)) for zone, v in errors.items()}}
        for name, errors in collected.items()
    ]


def _inside(places: Sequence[FieldPosition]) -> list[FieldPosition]:
    """Places on the frame: a point of light beyond it makes no picture."""
    kept = []
    for place in places:
        row, col = FRAME.pixel(place)
        if 0 <= round(row) < FRAME.height and 0 <= round(col) < FRAME.width:
            kept.append(place)
    return kept
