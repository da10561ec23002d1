"""What caution costs and spares: one photo corrected with several beliefs about the same PSFs.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.caution \
        --seeds 6 5 1 --grids GRID.npz ... [--photos 1 2]

Each lens is learned from its first n photos as in `lensmodel.lab.chain.blind_gain`, and one more photo is
corrected by default settings with the beliefs of `RULES` (`model/trust/witness.py`: a prior of what may
have become of a kernel, and a factor on the variance), with the model's answers as if they were certain,
and with the true PSFs. Printed are the gains in PSNR of the sRGB picture by zone, each block after its own
best shift, the same in linear light with what was expected of it, and the share of blocks that lose more
than 0.5 dB. Four minutes a lens and number of photos on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from lensmodel import correction, photo
from lensmodel.core.belief import Belief, UncertainField
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfField, PsfSample
from lensmodel.core.types import ZONES, Channel, FieldPosition, Kernel
from lensmodel.lab.chain.blind_gain import (
    CAMERA,
    KnownLens,
    lenses,
    registered_gains,
    seed_range,
    shot,
    shown,
    written,
)
from lensmodel.model import LensModel, ModelSettings, WitnessedField
from lensmodel.model.trust.witness import OF_BOTH, SPREAD_OF_BOTH
from lensmodel.photo import LinearPhoto
from lensmodel.quality.images import to_srgb
from lensmodel.workflow import pipeline
from lensmodel.workflow.correcting import psfs_for

Prior = tuple[tuple[float, ...], ...]

SURER: Final[Prior] = ((0.06, 0.04, 0.04, 0.03), (0.37, 0.18, 0.2, 0.08))
"""A prior that takes one kernel of two for too wide, where the default takes three of four (chosen)."""

RULES: Final[dict[str, tuple[Prior, float]]] = {
    "default": (OF_BOTH, SPREAD_OF_BOTH),
    "half the variance": (OF_BOTH, 0.5 * SPREAD_OF_BOTH),
    "a quarter": (OF_BOTH, 0.25 * SPREAD_OF_BOTH),
    "surer": (SURER, SPREAD_OF_BOTH),
    "surer, a quarter": (SURER, 0.25 * SPREAD_OF_BOTH),
}
"""Prior of the alternatives and factor on their variance."""


@dataclass(frozen=True, slots=True, eq=False)
class Rescaled:
    """An uncertain field with `factor` times the variance of another."""

    field: UncertainField
    factor: float

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """The mean kernel, unchanged."""
        return self.field.kernel_at(position, channel, size)

    def belief_at(self, position: FieldPosition, channel: Channel, size: int) -> Belief:
        """The belief, widened."""
        return self.field.belief_at(position, channel, size).widened(self.factor)


def fields(lens: KnownLens, model: LensModel, developed: LinearPhoto) -> Iterator[tuple[str, PsfField]]:
    """The same lens believed in by each rule, taken as certain, and as it is."""
    witnessed = psfs_for(developed, model, lens.settings)
    assert isinstance(witnessed, WitnessedField), "models of this command are not the paper's"
    for name, (prior, spread) in RULES.items():
        own = replace(witnessed, witness=replace(witnessed.witness, prior=prior))
        yield name, Rescaled(own, spread / SPREAD_OF_BOTH)
    pixels = developed.info.metadata.pixel_pitch_um, developed.frame.half_diagonal
    yield "certain", model.field(lens.settings, pitch_um=pixels[0], half_diagonal_px=pixels[1])
    yield "true PSF", lens.lens.field(lens.settings)


def rows(lens: KnownLens, counts: list[int], folder: Path) -> Iterator[str]:
    """Rows of the table of one lens."""
    files = [
        written(folder / f"{lens.name}-{k}.dng", shot(lens, k), tiff=False) for k in range(max(counts) + 1)
    ]
    learned = [_samples(path, lens) for path in files[: max(counts)]]
    sharp, developed = shot(lens, max(counts)).sharp, photo.develop(files[-1])
    lateral = pipeline.lateral_of(developed)
    pictures = to_srgb(shown(developed.planes)), to_srgb(shown(sharp))
    for count in counts:
        known = [sample for own in learned[:count] for sample in own]
        if not known:
            yield f"| {lens.name} | {count} | its photos show too little | | | | |"
            continue
        model = LensModel.fit(known, ModelSettings()).warmed()
        for name, field in fields(lens, model, developed):
            made: correction.Corrected = pipeline.correct_photo(
                developed, model, lens.settings, lateral=lateral, known=field
            )
            seen = registered_gains(pictures[0], to_srgb(shown(made.planes)), pictures[1])
            linear = registered_gains(developed.planes, made.planes, sharp)
            announced = [made.zones[zone].expected_gain_db if zone in made.zones else None for zone in ZONES]
            gained, light = (" / ".join(f"{g.zones[z]:+.2f}" for z in ZONES) for g in (seen, linear))
            expected = " / ".join("?" if gain is None else f"{gain:+.1f}" for gain in announced)
            lost = f"{seen.loss_share:.1%}"
            yield f"| {lens.name} | {count} | {name} | {gained} | {light} | {expected} | {lost} |"


def _samples(path: Path, lens: KnownLens) -> list[PsfSample]:
    """Samples of a photo; none where it shows too little."""
    try:
        return pipeline.samples_of_photo(path, pipeline.Recipe(lens.settings), workers=1)
    except NotEnoughEvidenceError:
        return []


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, nargs="+", default=[1])
    wanted = parser.parse_args()
    print("| lens | n | belief | gain center / mid / corner, dB | in linear light | expected | lost blocks |")
    print("|---|---|---|---|---|---|---|")
    seeds = [seed for part in wanted.seeds for seed in part]
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(seeds, wanted.grids, CAMERA.full_well_electrons):
            for row in rows(lens, wanted.photos, Path(name)):
                print(row, flush=True)


if __name__ == "__main__":
    main()
