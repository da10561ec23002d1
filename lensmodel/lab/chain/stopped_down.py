r"""What photos of the same lens stopped down add to what photos wide open tell of it.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.stopped_down --seeds 0 1 3 4 \
        [--traced OPEN.npz:CLOSED.npz] [--aperture 8] [--open 1 2 5] [--stopped 0 1 2 5] \
        [--samples FOLDER]

A blind estimate cannot tell a soft scene from a soft lens. Photos at f/5.6 to f/11 are hardly blurred by the
lens, so they show what its owner's scenes look like. Each lens takes photos as in
`lensmodel.lab.chain.blind_gain`, wide open and at `--aperture`, of different photographs as far as there are
enough, and is learned from each number of the ones with each number of the others.

Printed are, for the lens wide open and green, by zone (center / mid / corner): the median relative L2 error
of the regression's kernels, of the wavefront and of the belief that a correction uses, and the mean gain of a
linear filter by that belief (`lensmodel.lab.model.belief_prior`), with the least of its sixteen places. Some
twenty seconds a photo and twenty a fit on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import distance
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, KnownLens, lenses
from lensmodel.lab.model.belief_prior import SIZE, Rule, places
from lensmodel.lab.model.joint_answer import samples_of
from lensmodel.lab.traced import GridLens, read_grid
from lensmodel.model import LensModel, ModelSettings, WitnessedField

_ZONES: Final = (slice(0, 4), slice(4, 12), slice(12, 16))
"""Of `PLACES`: center, mid field, corner."""


def errors(lens: KnownLens, model: LensModel) -> NDArray[np.float64]:
    """Relative L2 of regression, wavefront (NaN without) and belief at each place, `(3, 16)`."""
    field, truth = WitnessedField.of(model, lens.settings), lens.lens.field(lens.settings)
    rows = []
    for place in PLACES:
        true = truth.kernel_at(place, "g", SIZE)
        kernels = [opinion.kernel_at(place, "g", SIZE) for opinion in field.fields]
        off = [distance(kernel, true).rel_l2 for kernel in kernels]
        believed = distance(field.belief_at(place, "g", SIZE).kernel, true).rel_l2
        rows.append([off[0], off[1] if len(off) > 1 else np.nan, believed])
    return np.array(rows).T


def pairs(
    seeds: Sequence[int], traced: Sequence[str], aperture: float
) -> Iterator[tuple[KnownLens, KnownLens]]:
    """Each lens wide open and stopped down."""
    for lens in lenses(seeds, [], CAMERA.full_well_electrons):
        yield lens, closed_to(lens, aperture)
    for number, names in enumerate(traced):
        open_, closed = (read_grid(Path(name)) for name in names.split(":"))
        lens = KnownLens(
            Path(names.split(":")[0]).stem, GridLens((open_, closed)), open_.f_number, 2000 + number, CAMERA
        )
        yield lens, closed_to(lens, closed.f_number)


def closed_to(lens: KnownLens, aperture: float) -> KnownLens:
    """Return a lens stopped down."""
    return replace(lens, name=f"{lens.name}-f{aperture:g}", f_number=aperture)


def main() -> None:
    """Learn each lens from each combination and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--traced", nargs="*", default=[], metavar="OPEN:CLOSED")
    parser.add_argument("--aperture", type=float, default=8.0, help="f-number of the stopped-down photos")
    parser.add_argument("--open", type=int, nargs="*", default=[1, 2, 5])
    parser.add_argument("--stopped", type=int, nargs="*", default=[0, 1, 2, 5])
    parser.add_argument("--samples", type=Path, help="folder that keeps what patches gave")
    wanted = parser.parse_args()
    print(
        "| lens | open | stopped down | kernels | wavefront | belief | gain, dB | least |\n"
        + "|---" * 8
        + "|"
    )
    rule = Rule.of_product()
    with tempfile.TemporaryDirectory() as name:
        folder = wanted.samples or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for lens, closed in pairs(wanted.seeds, wanted.traced, wanted.aperture):
            most = max(wanted.open)
            wide = [samples_of(lens, number, folder) for number in range(most)]
            narrow = [samples_of(closed, most + number, folder) for number in range(max(wanted.stopped))]
            for few in wanted.open:
                for more in wanted.stopped:
                    samples = [s for photo in (*wide[:few], *narrow[:more]) for s in photo]
                    model = LensModel.fit(samples, ModelSettings()).warmed()
                    off = errors(lens, model)
                    gains = np.array([place.gain(rule) for place in places(lens, model)])
                    cells = [" / ".join(f"{np.median(row[zone]):.2f}" for zone in _ZONES) for row in off]
                    gained = (
                        " / ".join(f"{gains[zone].mean():+.1f}" for zone in _ZONES) if gains.size else "-"
                    )
                    least = f"{gains.min():+.1f}" if gains.size else "-"
                    print(
                        f"| {lens.name} | {few} | {more} | {' | '.join(cells)} | {gained} | {least} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
