"""Fig. 2: what efficient filter flow applies between its PSFs, beside regressions, fed with true PSFs.

The flow's PSFs stand on a regular grid of 4 x 6 windows with half overlap and Bartlett-Hann slopes, as the
paper has it; the regressions see as many, one at a random place of each window. What the flow applies at a
pixel is the answer of its operator to a point of light there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from lab.correction.filter_flow import EfficientFilterFlow
from lab.model.model_benchmark import PATCHES, asked_places, patch_places, predictor
from lab.reproduce.cases import Case
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.psf import PsfField, PsfSample, as_kernel, distance
from lensmodel.core.types import ZONES, FieldPosition, Kernel, LensSettings

EFF: Final = "efficient filter flow"
REGRESSIONS: Final = {"the paper's regression": "paper", "regression of today's default": "combined"}
SIZE: Final = 31  # pixels of a kernel: that of an estimate
FRAME: Final = Frame(288, 432)
"""Of the flow. Weights depend on the place in the field alone: a small frame is as good as a large one."""

Predictor = Callable[[FieldPosition], Kernel]


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
