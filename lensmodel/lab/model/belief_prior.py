r"""What the witnesses' prior is worth, and what it would be worth with each of its numbers halved or doubled.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.belief_prior --seeds 0:10 [--grids FILE.npz ...]

Each lens takes two photos as in `lensmodel.lab.chain.blind_gain`, and is learned by default settings from
each and from both; with `--photos 1 2 5`, from the first one, two and five of five. At sixteen places the
patches say how likely each alternative to the kernels is (`model/trust/witness.py`), and what a belief of
them is worth is the gain of the linear filter that it asks for, behind the true PSF, at frequencies of a
scene that falls off with 1/f^2 and noise of base ISO::

    G = E[H]* S / ( (|E[H]|^2 + v Var[H]) S + n ),      gain = E0 / sum S |1 - H G|^2 + n |G|^2

after the best shift of the true PSF, since no blind method knows where the picture lies. Printed are the
mean gain of all places in dB, the share that loses more than 0.05 dB, and the least. `--search N` tries N
random changes of the prior, one after the other, and keeps what gains more and loses no more. Some two
minutes a photo on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.belief import GRID
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample, otf
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, KnownLens, lenses, seed_range, shot, written
from lensmodel.model import LensModel, ModelSettings, WitnessedField
from lensmodel.model.trust.witness import HALF, NARROWINGS, OF_BOTH, SPREAD_OF_BOTH, TEMPER
from lensmodel.workflow import pipeline

SIZE: Final = 55  # pixels of a kernel: what the grids hold
NOISE: Final = 16.0 / 300.0
"""Power of the noise where that of the scene is 1/f^2: 1/300 of it at 0.25 cycles/pixel."""
SHIFTS: Final = np.arange(-2.0, 2.01, 0.25)  # pixels, tried along rows and columns (chosen)
HARM: Final = 6.0
"""How much more a dB that is lost counts than one that is gained, in a search."""

Spectrum = NDArray[np.complex128]
# By frequency: its square, the power of the scene, and how often the whole spectrum holds it.
_ROWS, _COLS = np.fft.fftfreq(GRID[0])[:, None], np.fft.rfftfreq(GRID[1])[None, :]
_F2 = _ROWS**2 + _COLS**2
_SCENE = np.divide(1.0, _F2, out=np.zeros_like(_F2), where=_F2 > 0.0)
_TIMES = np.where((_COLS == 0.0) | (_COLS == 0.5), 1.0, 2.0) * (_F2 > 0.0)


@dataclass(frozen=True, slots=True)
class Rule:
    """The numbers of a belief: the prior of the alternatives, t = temper m / (m + half), and v."""

    prior: NDArray[np.float64]
    temper: float = TEMPER
    half: float = HALF
    spread: float = SPREAD_OF_BOTH

    @classmethod
    def of_product(cls) -> Rule:
        """Take those of the product."""
        return cls(np.array(OF_BOTH))


@dataclass(frozen=True, slots=True, eq=False)
class TruePlace:
    """The true transfer function of a place, the alternatives to it, and what patches say of them.

    Parameters
    ----------
    truth : ndarray of complex, shape (64, 33)
    alternatives : ndarray of complex, shape (opinions, len(NARROWINGS), 64, 33)
    costs : ndarray, shape (opinions, len(NARROWINGS))
    photos : float
        How many speak.
    """

    truth: Spectrum
    alternatives: Spectrum
    costs: NDArray[np.float64]
    photos: float

    def gain(self, rule: Rule) -> float:
        """Gain in dB of the linear filter by the belief that a rule makes."""
        shares = rule.prior * np.exp(
            -rule.temper * self.photos / (self.photos + rule.half) * (self.costs - self.costs.min())
        )
        shares /= shares.sum()
        mean = np.tensordot(shares, self.alternatives, axes=2)
        power = np.abs(mean) ** 2
        spread = np.tensordot(shares, np.abs(self.alternatives) ** 2, axes=2) - power
        linear = mean.conj() * _SCENE
        linear /= (power + rule.spread * np.maximum(spread, 0.0)) * _SCENE + NOISE
        return float(10.0 * np.log10(_error(self.truth, np.ones_like(linear)) / _error(self.truth, linear)))


def _error(truth: Spectrum, linear: Spectrum) -> float:
    left = _SCENE * np.abs(1.0 - truth * linear) ** 2 + NOISE * np.abs(linear) ** 2
    return float((_TIMES * left).sum())


def _shifted(truth: Spectrum, towards: Spectrum) -> Spectrum:
    """Bring a transfer function as near to another one as a shift does."""
    moved = [
        truth * np.exp(-2j * np.pi * (_ROWS * down + _COLS * right)) for down in SHIFTS for right in SHIFTS
    ]
    return min(moved, key=lambda one: float((_TIMES * _SCENE * np.abs(one - towards) ** 2).sum()))


def places(lens: KnownLens, model: LensModel) -> Iterator[TruePlace]:
    """Places of a lens by a fitted model; none where it has no wavefront."""
    field, truth = WitnessedField.of(model, lens.settings), lens.lens.field(lens.settings)
    if len(field.opinions) == 1:
        return
    for place in PLACES:
        kernels = [one.kernel_at(place, "g", SIZE) for one in field.fields]
        made = np.array([[otf(change.of(kernel), GRID) for change in NARROWINGS] for kernel in kernels])
        costs, photos = field.witness.evidence(place)
        true = _shifted(otf(truth.kernel_at(place, "g", SIZE), GRID), made[:, :2].mean(axis=(0, 1)))
        yield TruePlace(true, made, costs, photos)


def learned(lens: KnownLens, folder: Path, counts: Sequence[int] = ()) -> Iterator[list[PsfSample]]:
    """Samples of the first photos of a lens, `counts` of them, or of either of two and of both."""
    photos: list[list[PsfSample]] = []
    for number in range(max(counts, default=2)):
        path = written(folder / f"{lens.number}-{number}.dng", shot(lens, number), tiff=False)
        try:
            photos.append(pipeline.samples_of_photo(path, pipeline.Recipe(lens.settings), workers=1))
        except NotEnoughEvidenceError:
            photos.append([])
    parts = [photos[:count] for count in counts] or [[own] for own in photos] + [photos] * all(photos)
    for part in parts:
        if samples := [sample for own in part for sample in own]:
            yield samples


def judged(seen: Sequence[TruePlace], rule: Rule) -> tuple[float, float, float]:
    """Mean gain, share of places that lose more than 0.05 dB, and least gain."""
    gains = np.array([place.gain(rule) for place in seen])
    return float(gains.mean()), float((gains < -0.05).mean()), float(gains.min())


def searched(seen: Sequence[TruePlace], rule: Rule, tries: int) -> Rule:
    """Change the prior at random and keep what is worth more."""

    def worth(candidate: Rule) -> float:
        gains = np.array([place.gain(candidate) for place in seen])
        return float(gains.mean() + HARM * np.minimum(gains, 0.0).mean())

    rng, most = np.random.default_rng(0), worth(rule)
    for _ in range(tries):
        changed = rule.prior * np.exp(
            rng.normal(0.0, 0.5, rule.prior.shape) * (rng.random(rule.prior.shape) < 0.4)
        )
        candidate = Rule(changed / changed.sum(), rule.temper * float(np.exp(rng.normal(0.0, 0.1))))
        if (found := worth(candidate)) > most:
            rule, most = candidate, found
    return rule


def variants(rule: Rule) -> Iterator[tuple[str, Rule]]:
    """The rule, and each of its numbers halved and doubled."""
    yield "as it is", rule
    for opinion, name in enumerate(("kernels", "wavefront")):
        for narrowing, change in enumerate(NARROWINGS):
            for factor in (0.5, 2.0):
                prior = rule.prior.copy()
                prior[opinion, narrowing] *= factor
                words = f"{name}, width {change.width:g}, share {change.share:g}: x {factor:g}"
                yield words, Rule(prior / prior.sum(), rule.temper, rule.half, rule.spread)
    for factor in (0.5, 2.0):
        yield f"t: x {factor:g}", Rule(rule.prior, factor * rule.temper, rule.half, rule.spread)
        yield f"v: x {factor:g}", Rule(rule.prior, rule.temper, rule.half, factor * rule.spread)


def main() -> None:
    """Collect the places and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, nargs="*", default=[], help="how many photos to learn from")
    parser.add_argument("--search", type=int, default=0, help="random changes to try")
    wanted = parser.parse_args()
    seen: list[TruePlace] = []
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids, CAMERA.full_well_electrons):
            for samples in learned(lens, Path(name), wanted.photos):
                seen += places(lens, LensModel.fit(samples, ModelSettings()).warmed())
    rule = Rule.of_product()
    print(f"{len(seen)} places\n\n| prior | mean gain, dB | lose | least |\n|---|---|---|---|")
    for words, variant in variants(rule):
        mean, lose, least = judged(seen, variant)
        print(f"| {words} | {mean:+.2f} | {lose:.1%} | {least:+.2f} |", flush=True)
    if wanted.search:
        found = searched(seen, rule, wanted.search)
        mean, lose, least = judged(seen, found)
        words = f"{found.prior.round(3).tolist()}, t {found.temper:.2f}"
        print(f"| {words} | {mean:+.2f} | {lose:.1%} | {least:+.2f} |")


if __name__ == "__main__":
    main()
