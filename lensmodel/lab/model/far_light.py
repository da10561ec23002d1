"""What shadows in photos say of the light that their lens throws far, and what it is.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.far_light --seeds 0:7 [--grids FILE.npz ...]

Each lens takes some photos as in `lensmodel.lab.chain.blind_gain`. Printed are, by zone, the share of the
true PSF's light that lies more than 4.5 pixels from its centre of mass, the bound of each photo, least of 24
places (`lensmodel.estimation.darkest`), and what the model expects from the first photo, from two and from
all (`lensmodel.model.far_light`). Below follow the quartiles of the scenes' own light, s, over all photos of
lenses that throw less than `LITTLE_LIGHT` so far, and the mean share of the others. Ten seconds a photo on
one core.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel import photo
from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import centroid
from lensmodel.core.types import ZONES, Kernel, Zone
from lensmodel.estimation.darkest import darkest_share
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, KnownLens, lenses, seed_range, shot, written
from lensmodel.model.far_light import expected_share

CORE_PX: Final = 4.5  # radius (chosen: a little more than where far light begins, since cores have skirts)
LITTLE_LIGHT: Final = 0.05  # share (chosen: below, a lens counts as one without far light)
_SIDE: Final = 55  # pixels of a true kernel: what the grids hold
_ROWS, _COLS = 4, 6  # places of a photo whose surroundings are looked at (chosen: they overlap by a half)


def share_outside(kernel: Kernel) -> float:
    """Share of a kernel's light more than `CORE_PX` from its centre of mass."""
    row, col = centroid(kernel)
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    return float(kernel[np.hypot((t - row)[:, None], (t - col)[None, :]) > CORE_PX].sum() / kernel.sum())


def true_shares(lens: KnownLens) -> dict[Zone, float]:
    """Median over the places of each zone, green."""
    field = lens.lens.field(lens.settings)
    seen = [(zone_of(place.r), share_outside(field.kernel_at(place, "g", _SIDE))) for place in PLACES]
    return {zone: float(np.median([share for own, share in seen if own == zone])) for zone in ZONES}


def bounds(lens: KnownLens, number: int, folder: Path) -> dict[Zone, float]:
    """Least bound of a photo in each zone; 1 where none is to be had."""
    developed = photo.develop(written(folder / "photo.dng", shot(lens, number), tiff=False))
    frame, least = developed.frame, dict.fromkeys(ZONES, 1.0)
    for i in range(_ROWS):
        for j in range(_COLS):
            row, col = round((i + 0.5) * frame.height / _ROWS), round((j + 0.5) * frame.width / _COLS)
            found = darkest_share(developed.planes[1], float(developed.clip[1]), row, col)
            zone = zone_of(frame.position(row, col).r)
            least[zone] = least[zone] if found is None else min(least[zone], found)
    return least


def answer(seen: NDArray[np.float64], count: int) -> float:
    """What is expected from the first so many photos."""
    return float(expected_share(seen[None, :count])[0])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, default=5)
    wanted = parser.parse_args()
    print("| lens | zone | true share | bounds of its photos | expected from 1 / 2 / all |")
    print("|---|---|---|---|---|")
    own: list[float] = []
    some: list[float] = []
    for lens in lenses(wanted.seeds, wanted.grids, CAMERA.full_well_electrons):
        with tempfile.TemporaryDirectory() as folder:
            photos = [bounds(lens, number, Path(folder)) for number in range(wanted.photos)]
        for zone, true in true_shares(lens).items():
            seen = np.array([one[zone] for one in photos])
            listed = ", ".join(f"{bound:.2f}" for bound in seen)
            expected = " / ".join(f"{answer(seen, count):.2f}" for count in (1, 2, len(seen)))
            print(f"| {lens.name} | {zone} | {true:.3f} | {listed} | {expected} |", flush=True)
            if true < LITTLE_LIGHT:
                own += list((seen - true) / (1.0 - true))
            else:
                some.append(true)
    if own:
        lower, median, upper = np.quantile(own, (0.25, 0.5, 0.75))
        print(f"\nlight of the scenes themselves, quartiles: {lower:.3f}, {median:.3f}, {upper:.3f}")
    if some:
        print(f"far light where there is some: {np.mean(some):.3f} in the mean of {len(some)} zones")


if __name__ == "__main__":
    main()
