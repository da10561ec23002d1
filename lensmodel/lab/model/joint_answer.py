r"""How near averaged kernels, the wavefront and means of both are to the truth, and what error to expect.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.joint_answer --seeds 0 1 3 4 5 \
        --grids GRID.npz ... [--photos 1 2 5] [--channel g] [--samples FOLDER]

Each lens takes photos as in `lensmodel.lab.chain.blind_gain` and is learned from the first n. At sixteen
places the PSF of a channel is asked of the regression, of the wavefront, and of means with shares of the
wavefront from a quarter to seven eighths. Printed is the relative L2 error by lens and zone (median of the
places), its mean by family, and how often each answer is nearer than the worse and the better of the two.

Then the error to tell: ln e = a + b r + c ln(d + 0.02), with d the relative L2 by which the two differ. The
coefficients are those of `lensmodel.model.trust.expected_error.joint_error`; how often it is right within a
factor of 1.5 is told for lenses that were left out of the fit, one after the other.

`--samples` keeps what patches gave, so that another run of the same code estimates nothing anew. Some twenty
seconds a photo and a fit on one core.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample, distance
from lensmodel.core.types import CHANNELS, Channel
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, KnownLens, lenses, shot, written
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.modes import relative_l2
from lensmodel.workflow import pipeline

SHARES: Final = (0.0, 0.25, 0.5, 0.75, 0.875, 1.0)
"""Of the wavefront."""

_SIZE: Final = 55  # pixels of a kernel: what the grids hold
_ZONES: Final = (slice(0, 4), slice(4, 12), slice(12, 16))
"""Of `PLACES`: center, mid field, corner."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LensErrors:
    """One lens learned from some photos.

    Parameters
    ----------
    lens : str
    drawn : bool
        Whether it is of third order.
    photos : int
    errors : ndarray, shape (16, shares)
    apart, r : ndarray, shape (16,)
    """

    lens: str
    drawn: bool
    photos: int
    errors: Array
    apart: Array
    r: Array


def samples_of(lens: KnownLens, number: int, folder: Path) -> list[PsfSample]:
    """Samples of one photo, from the folder where they are kept or anew."""
    kept = folder / f"{lens.name}-{number}.pickle"
    if kept.exists():
        samples: list[PsfSample] = pickle.loads(kept.read_bytes())  # noqa: S301 - written below
        return samples
    path = written(folder / f"{lens.number}-{number}.dng", shot(lens, number), tiff=False)
    try:
        samples = pipeline.samples_of_photo(path, pipeline.Recipe(lens.settings), workers=1)
    except NotEnoughEvidenceError:
        samples = []
    path.unlink()
    kept.write_bytes(pickle.dumps(samples))
    return samples


def row_of(
    lens: KnownLens, photos: int, samples: Sequence[PsfSample], channel: Channel = "g"
) -> LensErrors | None:
    """Learn and compare; None where no wavefront fits."""
    model = LensModel.fit(samples, ModelSettings()).warmed()
    kernels, wavefront = model.opinion("kernels"), model.opinion("wavefront")
    if kernels is None or wavefront is None:
        return None
    truth, asked = lens.lens.field(lens.settings), lens.settings.with_channel(channel)
    averaged, rendered = (one.kernels(PLACES, asked, _SIZE) for one in (kernels, wavefront))
    errors = [
        [
            distance((1.0 - share) * k + share * w, truth.kernel_at(place, channel, _SIZE)).rel_l2
            for share in SHARES
        ]
        for place, k, w in zip(PLACES, averaged, rendered, strict=True)
    ]
    r = np.array([place.r for place in PLACES])
    drawn = lens.number < 2000
    return LensErrors(lens.name, drawn, photos, np.array(errors), relative_l2(rendered, averaged), r)


def print_errors(rows: Sequence[LensErrors]) -> None:
    """Print the tables of errors."""
    print("\n| lens, photos | " + " | ".join(f"{share:g}" for share in SHARES) + " |")
    print("|---" * (len(SHARES) + 1) + "|")
    for row in rows:
        cells = [
            " / ".join(f"{np.median(row.errors[zone, k]):.2f}" for zone in _ZONES) for k in range(len(SHARES))
        ]
        print(f"| {row.lens}, {row.photos} | {' | '.join(cells)} |")
    for words, drawn in (("third order", True), ("ray-traced", False)):
        own = [row.errors for row in rows if row.drawn == drawn]
        if own:
            means = np.concatenate(own).mean(axis=0)
            print(f"| mean, {words} | {' | '.join(f'{mean:.3f}' for mean in means)} |")
    errors = np.concatenate([row.errors for row in rows])
    two = errors[:, [0, -1]]
    for words, limit in (
        ("nearer than the worse, %", two.max(axis=1)),
        ("than the better, %", two.min(axis=1)),
    ):
        shares = (errors <= limit[:, None] * 1.0001).mean(axis=0)
        print(f"| {words} | {' | '.join(f'{share:.0%}' for share in shares)} |")


def features(rows: Sequence[LensErrors]) -> Array:
    """1, r and ln(d + 0.02), `(n, 3)`."""
    r, apart = (np.concatenate([getattr(row, name) for row in rows]) for name in ("r", "apart"))
    return np.stack([np.ones_like(r), r, np.log(apart + 0.02)], axis=1)


def print_expected_error(rows: Sequence[LensErrors], share: float) -> None:
    """Print the coefficients of the expected error of the mean with a share, and how often it is right."""
    column = SHARES.index(share)

    def logs(some: Sequence[LensErrors]) -> Array:
        return np.log(np.concatenate([row.errors[:, column] for row in some]))

    def fitted(some: Sequence[LensErrors]) -> Array:
        return np.asarray(np.linalg.lstsq(features(some), logs(some), rcond=None)[0])

    off = []
    for name in sorted({row.lens for row in rows}):
        own, others = [r for r in rows if r.lens == name], [r for r in rows if r.lens != name]
        off.append(features(own) @ fitted(others) - logs(own))
    right = np.abs(np.concatenate(off)) < np.log(1.5)
    words = ", ".join(f"{value:.2f}" for value in fitted(rows))
    print(f"\nshare {share:g}: a, b, c = {words}; right within 1.5 of lenses left out: {right.mean():.0%}")


def main() -> None:
    """Learn the lenses and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, nargs="*", default=[1, 2, 5])
    parser.add_argument("--channel", choices=CHANNELS, default="g", help="whose PSFs are asked for")
    parser.add_argument("--samples", type=Path, help="folder that keeps what patches gave")
    wanted = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = wanted.samples or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for lens in lenses(wanted.seeds, wanted.grids, CAMERA.full_well_electrons):
            for count in wanted.photos:
                samples = [s for number in range(count) for s in samples_of(lens, number, folder)]
                row = row_of(lens, count, samples, wanted.channel) if samples else None
                print(f"{lens.name}, {count} photos: {'no wavefront' if row is None else 'done'}", flush=True)
                rows += [] if row is None else [row]
    print_errors(rows)
    if len({row.lens for row in rows}) > 1:
        for share in (0.0, 0.5, 0.75):
            print_expected_error(rows, share)


if __name__ == "__main__":
    main()
