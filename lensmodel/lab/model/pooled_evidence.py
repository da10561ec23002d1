"""What solving all patches together adds to kernels estimated one by one, in the mode `wavefront`.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.pooled_evidence --seeds 1008,1010,1013 --photos 2

Photographs of the test half are taken by simulated lenses as Bayer DNG files and calibrated as a user does.
The same samples make two models, with the spectra of their patches and without. Printed is the median
relative L2 of green PSFs against the truth at 48 places that are no patches, in center, mid and corner.
With `--patches 8` only so many patches of each photo count, as in small photos; `--half dev` takes the
photographs of the development half, for lenses of development seeds.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import PsfSample, distance, rms_width
from lensmodel.core.types import ZONES, FieldPosition, LensSettings
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.reproduce.scenes import centred_cut
from lensmodel.model import LensModel, ModelSettings
from lensmodel.simulate import SimulatedCamera, SimulatedField, draw_lens, load_scene, photograph, write_photo
from lensmodel.workflow import pipeline

_PLACES = 48  # on a spiral over the field (chosen)
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))  # radians: the golden angle spreads points evenly
_SIZE = 31  # pixels: that of an estimate
WAVEFRONT = ModelSettings(mode="wavefront")


def places() -> list[FieldPosition]:
    """Spread evenly over the disc of the field."""
    turned = [(k * _GOLDEN + math.pi) % (2.0 * math.pi) - math.pi for k in range(_PLACES)]
    return [FieldPosition(0.95 * math.sqrt((k + 0.5) / _PLACES), phi) for k, phi in enumerate(turned)]


def learned(seed: int, files: list[Path], folder: Path) -> tuple[list[list[PsfSample]], SimulatedField]:
    """Samples of each photo of a lens, and its truth."""
    lens, found = draw_lens(seed), []
    settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
    camera = SimulatedCamera(height=64, width=64)
    for number, file in enumerate(files):
        scene = load_scene(file)
        height, width = ((n - 56) // 2 * 2 for n in scene.shape[1:])
        camera = SimulatedCamera(height=height, width=width)
        rng = np.random.default_rng([seed, number])
        path = folder / f"{seed}-{number}.dng"
        write_photo(path, photograph(centred_cut(scene, height, width), lens, settings, camera, rng))
        found.append(pipeline.samples_of_photo(path))
    return found, SimulatedField(lens, settings, camera.pitch_um)


def spread_out(samples: list[PsfSample], patches: int) -> list[PsfSample]:
    """Keep the samples of so many patches, evenly from the center to the corner."""
    where = sorted({(s.position.r, s.position.phi) for s in samples})
    kept = {where[round(i)] for i in np.linspace(0, len(where) - 1, min(patches, len(where)))}
    return [s for s in samples if (s.position.r, s.position.phi) in kept]


def row(name: str, model: LensModel, truth: SimulatedField) -> None:
    """Print the errors of a model."""
    errors: dict[str, list[float]] = {zone: [] for zone in ZONES}
    widths: dict[str, list[float]] = {zone: [] for zone in ZONES}
    right = 0
    for place in places():
        answer = model.query(place, truth.settings, _SIZE)
        kernel = truth.kernel_at(place, "g", _SIZE)
        error = distance(answer.kernel, kernel).rel_l2
        errors[zone_of(place.r)].append(error)
        widths[zone_of(place.r)].append(rms_width(answer.kernel) / rms_width(kernel))
        right += 1 / 1.5 < answer.predicted_error / error < 1.5
    medians = " / ".join(f"{np.median(errors[zone]):.2f}" for zone in ZONES)
    wide = " / ".join(f"{np.median(widths[zone]):.2f}" for zone in ZONES)
    print(f"| {name} | {medians} | {wide} | {right / _PLACES:.0%} |", flush=True)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="1008,1010,1013", help="lenses, with commas between")
    parser.add_argument("--photos", type=int, default=2, help="photographs for each lens")
    parser.add_argument("--patches", type=int, help="patches of each photo that count; default: all")
    parser.add_argument("--half", choices=("dev", "test"), default="test", help="half of the photographs")
    arguments = parser.parse_args()
    data = os.environ.get("LENSMODEL_TEST_DATA")
    every = list_photos(Path(data) / "sharp" if data else None)
    files = [p for p in every if photo_half(p.stem) == arguments.half]
    print("| lens, photos, model | rel. L2 center / mid / corner | width | error foretold within 1.5x |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for seed in (int(text) for text in arguments.seeds.split(",")):
            order = np.random.default_rng(seed).permutation(len(files))[: arguments.photos]
            photos, truth = learned(seed, [files[i] for i in order], Path(folder))
            if arguments.patches is not None:
                photos = [spread_out(photo, arguments.patches) for photo in photos]
            for count in sorted({1, arguments.photos}):
                samples = [sample for photo in photos[:count] for sample in photo]
                name = f"{seed} {truth.lens.model.removeprefix('Simulated ')}, {count}"
                alone = [replace(sample, spectrum=None) for sample in samples]
                row(f"{name}, kernels", LensModel.fit(alone, WAVEFRONT).warmed(), truth)
                row(f"{name}, pooled", LensModel.fit(samples, WAVEFRONT).warmed(), truth)


if __name__ == "__main__":
    main()
