"""Photographs behind lenses that are known: the numbers of `patch` in `lensmodel.scene.prior`.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.scene_spectra --seeds 0:8 --photos 5

Photographs of the development half are taken by simulated lenses as Bayer DNG files, developed, and their
patches selected as in a calibration. With the true |OTF|^2 of each patch given, only the scene's own
polynomial is fitted, with wide priors; printed are medians and spreads (1.48 times the median absolute
deviation) of its coefficients within and between photos, and of what it leaves in each ring.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lensmodel import photo
from lensmodel.core.spectrum import SECTORS, PatchSpectrum, bin_frequencies
from lensmodel.core.types import CHANNELS, Channel, LensSettings
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.reproduce.scenes import centred_cut
from lensmodel.model.wavefront.scene_fit import fit_scene
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.scene.prior import ORBITS, PATCH_SHAPES
from lensmodel.simulate import SimulatedCamera, SimulatedField, draw_lens, load_scene, photograph, write_photo
from lensmodel.workflow import pipeline

Floats = NDArray[np.float64]
_ORDER: tuple[Channel, ...] = ("g", "r", "b")
_SIDE = 55  # pixels of true kernels: the largest side of estimates
_WIDE = 9.0  # how much wider than usual the priors are


@dataclass(frozen=True, slots=True, eq=False)
class PatchTruth:
    """Spectra of a patch and the true |OTF|^2 of its channels, shape (BINS, 3)."""

    photo: str
    scene: SceneView
    truth: Floats


def power_of(kernel: Floats) -> Floats:
    """|OTF|^2 of a kernel at the middles of the bins, by a direct sum."""
    modulus, angle = bin_frequencies()
    half = kernel.shape[0] // 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1]
    along = np.outer(modulus * np.sin(angle), row.ravel()) + np.outer(modulus * np.cos(angle), col.ravel())
    return np.asarray(np.abs(np.exp(-2j * np.pi * along) @ kernel.ravel()) ** 2)


def patches(seed: int, files: list[Path], folder: Path) -> Iterator[PatchTruth]:
    """Take, develop and select."""
    lens = draw_lens(seed)
    settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
    for number, file in enumerate(files):
        scene = load_scene(file)
        height, width = ((n - 56) // 2 * 2 for n in scene.shape[1:])
        camera = SimulatedCamera(height=height, width=width)
        rng = np.random.default_rng([seed, number])
        path = folder / "photo.dng"
        write_photo(path, photograph(centred_cut(scene, height, width), lens, settings, camera, rng))
        developed = photo.develop(path)
        field = SimulatedField(lens, settings, camera.pitch_um)
        for patch in pipeline.find_patches(developed, count=24).patches:
            window = np.s_[patch.row : patch.row + patch.size, patch.col : patch.col + patch.size]
            spectra: dict[Channel, PatchSpectrum] = {}
            truth = []
            for channel in _ORDER:
                index = CHANNELS.index(channel)
                plane = np.ascontiguousarray(developed.planes[index][window])
                spectra[channel] = PatchSpectrum.of(plane, developed.noise[index], 1.0)
                truth.append(power_of(field.kernel_at(patch.position, channel, _SIDE)))
            yield PatchTruth(f"{seed}/{file.stem}", SceneView.of(spectra), np.stack(truth, axis=1))


def spread(values: Floats) -> Floats:
    """1.48 times the median absolute deviation, which is the standard deviation of normal values."""
    return np.asarray(1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0))


def report(seen: list[PatchTruth]) -> None:
    """Fit the scenes and print."""
    shapes = PATCH_SHAPES.shape[1]
    fits = [fit_scene(replace(s.scene, vote=s.scene.vote / _WIDE), s.truth) for s in seen]
    unknowns = np.stack([fit.unknowns for fit in fits])
    photos = np.array([s.photo for s in seen])
    centres = np.stack([np.median(unknowns[photos == p], axis=0) for p in sorted(set(photos))])
    within = np.concatenate(
        [unknowns[photos == p] - np.median(unknowns[photos == p], axis=0) for p in set(photos)]
    )
    np.set_printoptions(precision=2, suppress=True, linewidth=160)
    print(f"{len(seen)} patches of {len(set(photos))} photos")
    print("usual              ", np.median(unknowns, axis=0)[:shapes])
    print("spread, all        ", spread(unknowns)[:shapes])
    print("spread within photo", spread(within)[:shapes])
    print("spread of photos   ", spread(centres)[:shapes])
    print("channels about it  ", spread(unknowns)[shapes:-1].reshape(3, 3))
    print("floor: usual, spread", np.array([np.median(unknowns[:, -1]), spread(unknowns)[-1]]))
    rest, signal = np.stack([fit.residual for fit in fits]), np.stack([fit.signal for fit in fits])
    for k, channel in enumerate(_ORDER):
        ring_rest = rest[:, :, k].reshape(len(seen), -1, SECTORS)
        strong = signal[:, :, k].reshape(ring_rest.shape) > 0.5
        rings = range(ring_rest.shape[1])
        middle = np.array([np.median(ring_rest[:, i][strong[:, i]]) for i in rings])
        print(channel, "beyond our bias ", middle)
        print(channel, "roughness       ", np.array([spread(ring_rest[:, i][strong[:, i]]) for i in rings]))

    pattern(rest[:, :, 0], signal[:, :, 0], np.stack([s.truth[:, 0] for s in seen]))


def pattern(rest: Floats, signal: Floats, power: Floats) -> None:
    """Print what green has beyond our bias by the angle to the sensor's axes, and as it goes with |OTF|^4."""
    print("g, beyond our bias at axes, diagonals, between: steady, per |OTF|^4")
    shape = len(rest), -1, SECTORS
    rest, strong, power = rest.reshape(shape), signal.reshape(shape) > 0.5, power.reshape(shape)
    for ring in range(rest.shape[1]):
        lines = []
        for orbit in range(3):
            here = np.s_[:, ring, orbit == ORBITS]
            known = strong[here]
            terms = np.stack([np.ones(known.sum()), power[here][known] ** 2], axis=1)
            lines.append(np.linalg.lstsq(terms, rest[here][known], rcond=None)[0])
        print(ring, np.array(lines).T)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="0:8", help="first:last lens, the last left out")
    parser.add_argument("--photos", type=int, default=5, help="photographs for each lens")
    arguments = parser.parse_args()
    data = os.environ.get("LENSMODEL_TEST_DATA")
    files = [p for p in list_photos(Path(data) / "sharp" if data else None) if photo_half(p.stem) == "dev"]
    first, last = (int(n) for n in arguments.seeds.split(":"))
    seen: list[PatchTruth] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, last):
            order = np.random.default_rng(seed).permutation(len(files))[: arguments.photos]
            seen += patches(seed, [files[i] for i in order], Path(folder))
            print(f"lens {seed}: {len(seen)} patches", flush=True)
    report(seen)


if __name__ == "__main__":
    main()
