"""How much a report would change with other photos: its model fitted anew to photos drawn again.

Photos are drawn with replacement, as many as there are; the standard deviation over the draws is the standard
error (B. Efron and R. Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 6). What all photos have in
common, such as a bias of the estimate, does not show.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.model import LensModel

DRAWS: Final = 16  # a standard deviation over so few is known to a fifth (chosen for time)
FEWEST: Final = 3  # groups: two have but three different draws (chosen)


def redrawn_models(model: LensModel, rng: np.random.Generator, draws: int) -> tuple[list[LensModel], str]:
    """Fit the model to samples drawn again.

    Returns
    -------
    models : list of LensModel
        Empty where there is nothing to draw from, or hardly a draw could be fitted.
    drawn : {"photos", "patches"}
        What was drawn: patches where there are fewer than three photos.
    """
    excluded = model.settings.excluded
    samples = [s for s in model.samples if s.photo not in excluded and s.settings.channel == "g"]
    drawn = "photos" if len({s.photo for s in samples}) >= FEWEST else "patches"
    groups: defaultdict[Hashable, list[PsfSample]] = defaultdict(list)
    for sample in samples:
        groups[sample.photo if drawn == "photos" else (sample.photo, sample.position)].append(sample)
    each = list(groups.values())
    models: list[LensModel] = []
    for _ in range(draws if len(each) >= FEWEST else 0):
        chosen = rng.integers(0, len(each), len(each))
        try:
            models.append(LensModel.fit(_copies(each, chosen), model.settings))
        except LensModelError:
            continue
    return (models if len(models) >= max(draws // 2, 2) else []), drawn


def _copies(groups: Sequence[list[PsfSample]], chosen: NDArray[np.integer]) -> list[PsfSample]:
    """Samples of the chosen groups; one that is drawn again is of another photo, or it would not count."""
    seen: Counter[int] = Counter()
    samples = []
    for number in map(int, chosen):
        copy = seen[number]
        samples += [s if copy == 0 else replace(s, photo=f"{s.photo} {copy}") for s in groups[number]]
        seen[number] += 1
    return samples
