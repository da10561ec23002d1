r"""What a photo gains that is corrected by a lens known only from other photos, and whether any of it loses.

    LENSMODEL_TEST_DATA=... python -m lab.blind_gain --seeds 1000:1008 --photos 1 2 \
        [--grids FILE.npz] [--electrons 2500] [--hot 60] [--crop 0.66]

Each lens takes Bayer DNG files of 1.2 megapixels of different photographs of the test half (the development
half for seeds below 1000), is learned from the first n, and another photo is corrected. With `--hot`, so many
pixels of the sensor shine in every photo, and gains count from the photo without them. With `--crop`, the
corrected photo is the middle of the frame. docs/lab/accuracy.md says what is printed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.cases import list_photos, photo_half
from lab.images import gains, middle, to_srgb
from lab.kernels import distance
from lab.traced import GridLens
from lensmodel import api, photo
from lensmodel.blind import sampling
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Planes
from lensmodel.model import LensModel
from lensmodel.simulate import SimulatedCamera, SimulatedLens, draw_lens, load_scene, photograph, write_photo

CAMERA: Final = SimulatedCamera(height=900, width=1350, full_well_electrons=20_000.0)
MARGIN: Final = 64  # pixels of a scene beyond the frame (chosen)
PLACES: Final = [FieldPosition(r, phi) for r in (0.05, 0.35, 0.6, 0.85) for phi in (0.4, 2.0, -2.4, -0.9)]


@dataclass(frozen=True, slots=True, eq=False)
class KnownLens:
    """A lens with known PSFs wide open, and the camera that it is on."""

    name: str
    lens: SimulatedLens | GridLens
    number: int
    camera: SimulatedCamera
    hot: int = 0  # pixels of the sensor that shine

    @property
    def settings(self) -> LensSettings:
        """Wide open."""
        return LensSettings(aperture=self.lens.f_number(LensSettings()))

    def shot(self, number: int, path: Path, crop: float = 1.0) -> Planes:
        """Take a photo as a DNG file, or its middle; return the sharp light behind it."""
        half = "test" if self.number >= 1000 else "dev"
        folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
        files = [file for file in list_photos(folder) if photo_half(file.stem) == half]
        scene = load_scene(files[(5 * self.number + 3 * number) % len(files)])
        if scene.shape[1] > scene.shape[2]:
            scene = np.rot90(scene, axes=(1, 2))
        wanted = self.camera.height, self.camera.width
        size = (min(n, w + MARGIN) // 2 * 2 for n, w in zip(scene.shape[1:], wanted, strict=True))
        part = middle(scene, *size)
        rng = np.random.default_rng([self.number, number])
        taken = photograph(part, self.lens, self.settings, self.camera, rng)
        taken = replace(taken, mosaic=self._with_hot_pixels(taken.mosaic))
        # cut where the mosaic repeats
        kept = [n - 4 * round((1.0 - crop) * n / 4.0) for n in taken.mosaic.shape]
        write_photo(path, replace(taken, mosaic=middle(taken.mosaic, *kept)))
        return middle(taken.sharp, *kept)

    def _with_hot_pixels(self, mosaic: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Let the same pixels shine in every photo."""
        rng, camera = np.random.default_rng([self.number, self.hot]), self.camera
        at = rng.choice(mosaic.size, self.hot, replace=False)
        values = mosaic.ravel().astype(np.int64)
        values[at] += (rng.uniform(0.1, 1.0, self.hot) * (camera.white - camera.black)).astype(np.int64)
        return np.minimum(values, camera.white).astype(np.uint16).reshape(mosaic.shape)

    def shown(self, planes: Planes) -> NDArray[np.float64]:
        """As a picture shows it, `(row, col, 3)`."""
        balance = np.asarray(self.camera.white_balance, dtype=np.float32)[:, None, None]
        return np.moveaxis(to_srgb(planes * balance), 0, -1)

    def psf_errors(self, model: LensModel) -> tuple[float, float]:
        """Median relative L2 error of green, true and expected."""
        truth, asked = self.lens.field(self.settings), self.settings.with_channel("g")
        answers = [model.query(place, asked, 55) for place in PLACES]
        pairs = zip(PLACES, answers, strict=True)
        true = [distance(answer.kernel, truth.kernel_at(place, "g", 55)).rel_l2 for place, answer in pairs]
        return float(np.median(true)), float(np.median([answer.predicted_error for answer in answers]))


def rows(lens: KnownLens, counts: Sequence[int], folder: Path, crop: float = 1.0) -> Iterator[list[str]]:
    """Learn a lens from some photos and correct another one: a row for each number of photos."""
    samples: list[list[PsfSample]] = []
    shots = [folder / f"{lens.number}-{number}.dng" for number in range(max(counts))]
    for number, path in enumerate(shots):
        lens.shot(number, path)
    for path in shots:
        config = sampling.configured("default", lens.settings)
        try:
            samples.append(sampling.samples_of_photo(path, config, workers=1))
        except NotEnoughEvidenceError:
            samples.append([])
    truth = replace(lens, hot=0).shot(max(counts), folder / "clean.dng", crop)
    clean = photo.develop(folder / "clean.dng")
    lens.shot(max(counts), folder / "last.dng", crop)
    developed = photo.develop(folder / "last.dng")
    for count in counts:
        known = [sample for own in samples[:count] for sample in own]
        if not known:
            yield [lens.name, str(count), "its photos show too little"]
            continue
        model = LensModel.fit(known)
        lateral = api.lateral_of(developed)
        made = api.correct_photo(developed, model, lens.settings, lateral=lateral)
        found = gains(*map(lens.shown, (clean.planes, made.planes, truth)))
        assert found is not None, "a frame of the camera holds many blocks"
        expected = {zone: report.expected_gain_db for zone, report in made.zones.items()}
        error, told = lens.psf_errors(model)
        yield [
            lens.name,
            str(count),
            " / ".join(f"{found.zones[zone]:+.2f}" for zone in ZONES),
            " / ".join("?" if (db := expected.get(zone)) is None else f"{db:+.1f}" for zone in ZONES),
            f"{error:.2f} ({told:.2f})",
            f"{found.loss_share:.1%}",
            f"{found.worst_db:+.2f}",
        ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", default="", help="first:last, the last excluded")
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, nargs="+", default=[1])
    parser.add_argument("--electrons", type=float, default=CAMERA.full_well_electrons)
    parser.add_argument("--hot", type=int, default=0, help="pixels of the sensor that shine in every photo")
    parser.add_argument("--crop", type=float, default=1.0, help="share of the frame that is corrected")
    wanted = parser.parse_args()
    camera = replace(CAMERA, full_well_electrons=wanted.electrons)
    seeds = range(*map(int, wanted.seeds.split(":"))) if wanted.seeds else ()
    lenses = [KnownLens(str(seed), draw_lens(seed), seed, camera, wanted.hot) for seed in seeds]
    for number, path in enumerate(wanted.grids):
        traced = GridLens.read(path)
        own = replace(camera, pitch_um=traced.grid.pitch_um)
        lenses.append(KnownLens(path.stem, traced, 2000 + number, own, wanted.hot))
    print("| lens | n | gain centre / mid / corner, dB | expected | PSF error (expected) | lost | worst |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses:
            for row in rows(lens, wanted.photos, Path(name), wanted.crop):
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
