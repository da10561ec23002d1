"""Whether patches protect a photo from kernels that are wrong, and leave the right ones alone.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.witness --seeds 1000:1008 [--grids FILE.npz ...]

Each lens has 24 places. Tiles of sharp photographs of the test half (the development half for seeds below
1000), blurred by the exact kernels there, make three photos, as Bayer DNG files. A model is given kernels of
the first two: the right ones, 1.3 and 1.6 times too wide, turned by 90 degrees, those of a place half a
half-diagonal away; all over, or in one quarter of the field only. Six tiles of the third photo are corrected
by `standard`, as the model answers and as its witnesses leave that (`model/trust/witness.py`).

Printed are, for each kind, the tiles, those that lose 0.3 dB or more as the model answers, how many of these
still lose 0.3 and 0.05 dB, and the share of the gain that is kept where kernels are right. `--grids` takes
node grids of `lensmodel.lab.traced`. Some two minutes a lens.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from lensmodel import correction, photo
from lensmodel.core.belief import Belief, UncertainField
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, PsfSample, centred, delta, resized, rms_width
from lensmodel.core.spectrum import PatchSpectrum
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings, Planes
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.images import psnr
from lensmodel.model import LensModel, WitnessedField
from lensmodel.photo import LinearPhoto
from lensmodel.simulate import SimulatedCamera, SimulatedField, draw_lens, load_scene, write_photo
from lensmodel.simulate.blur import BlurOptions
from lensmodel.simulate.camera import SimulatedPhoto, Truth

KINDS = ("right", "x1.3", "x1.6", "turned", "displaced", "x1.3 quarter", "x1.6 quarter", "displaced quarter")
TILE, ROWS, COLS, SIZE = 256, 4, 6, 55  # pixels of a tile, tiles of a frame (chosen), pixels of a kernel
INNER = slice(32, 224)
"""Of a tile, what serves as a patch: its rim holds its neighbour's light."""
ASKED, NEAR_QUARTER = (5, 4, 9, 13, 20, 6), 4  # tiles that are corrected (chosen); so many for one quarter
ERROR = 0.3
"""What estimators usually expect of their kernels."""
LOSS, LEAST = 0.3, 0.05  # dB of a clear loss, and of any that counts (chosen)
FRAME = Frame(ROWS * TILE, COLS * TILE)
CORNERS = [(row * TILE, col * TILE) for row in range(ROWS) for col in range(COLS)]
PLACES = [FRAME.position(row + TILE / 2 - 0.5, col + TILE / 2 - 0.5) for row, col in CORNERS]
Kernels = dict[Channel, Kernel]


@dataclass(frozen=True, slots=True, eq=False)
class OfPlace:
    """What a field says of one place, everywhere."""

    field: WitnessedField
    place: FieldPosition

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of the place."""
        return self.field.kernel_at(self.place, channel, size)

    def belief_at(self, position: FieldPosition, channel: Channel, size: int) -> Belief:
        """Return what is thought of the PSF of the place."""
        return self.field.belief_at(self.place, channel, size)


@dataclass(frozen=True, slots=True, eq=False)
class ByChannel:
    """One kernel a channel, everywhere, of a known error."""

    kernels: Kernels
    errors: dict[Channel, float]

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the channel's kernel."""
        return resized(self.kernels[channel], size)

    def belief_at(self, position: FieldPosition, channel: Channel, size: int) -> Belief:
        """Return it with its error."""
        return Belief.of_error(self.kernel_at(position, channel, size), self.errors[channel])


@dataclass(frozen=True, slots=True, eq=False)
class TilePhoto:
    """A developed photo of tiles, and its sharp light."""

    photo: LinearPhoto
    sharp: Planes

    def patch(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of a tile's patch."""
        row, col = CORNERS[number]
        return slice(row + INNER.start, row + INNER.stop), slice(col + INNER.start, col + INNER.stop)

    def spectrum(self, number: int, channel: Channel, kernel: Kernel) -> PatchSpectrum:
        """Spectrum of a patch and the side of its tails, as they are kept with an estimate of its kernel."""
        index = CHANNELS.index(channel)
        plane = np.ascontiguousarray(self.photo.planes[index][self.patch(number)])
        return PatchSpectrum.of(plane, self.photo.noise[index], rms_width(kernel))

    def gain(self, number: int, field: UncertainField) -> float:
        """Gain in PSNR (dB, sRGB) of one tile corrected with what is thought of its PSF."""
        row, col = CORNERS[number]
        window = slice(None), slice(row, row + TILE), slice(col, col + TILE)
        planes, rim = np.ascontiguousarray(self.photo.planes[window]), 12
        corrected = correction.correct_planes(
            planes,
            field,
            Frame(TILE, TILE),
            noise=self.photo.correction_noise,
            clip=self.photo.clip,
            cfa=self.photo.cfa,
            roi=(INNER.start, INNER.start, INNER.stop - INNER.start, INNER.stop - INNER.start),
            pitch=INNER.stop - INNER.start,
        ).planes[:, rim:-rim, rim:-rim]
        inner = slice(INNER.start + rim, INNER.stop - rim)
        before, truth = planes[:, inner, inner], self.sharp[window][:, inner, inner]
        # development undoes the white balance of the sensor: channels are brought to those of the truth
        scale = truth.mean(axis=(1, 2)) / before.mean(axis=(1, 2)) / truth.max()
        scale = scale.astype(np.float32)[:, None, None]
        truth = truth / truth.max()
        return psnr(corrected * scale, truth, srgb=True) - psnr(before * scale, truth, srgb=True)


def shoot(kernels: Sequence[Kernels], files: Sequence[Path], rng: np.random.Generator) -> TilePhoto:
    """Take a photo of tiles, each the busiest of three cuts of photographs."""
    camera = SimulatedCamera(height=FRAME.height, width=FRAME.width)
    clean = np.zeros((len(CHANNELS), FRAME.height, FRAME.width), dtype=np.float32)
    sharp = np.zeros_like(clean)
    margin = SIZE // 2
    side = TILE + 2 * margin
    for (row, col), known in zip(CORNERS, kernels, strict=True):
        cuts = []
        for _ in range(3):
            scene = load_scene(files[int(rng.integers(len(files)))])
            top, left = (int(rng.integers(extent - side)) for extent in scene.shape[1:])
            cuts.append(scene[:, top : top + side, left : left + side])
        cut = max(cuts, key=lambda one: np.abs(ndimage.gaussian_laplace(one[1], 1.0)).mean() / one[1].mean())
        window = slice(row, row + TILE), slice(col, col + TILE)
        for index, channel in enumerate(CHANNELS):
            clean[index][window] = signal.oaconvolve(cut[index], known[channel], mode="valid")
            sharp[index][window] = cut[index, margin:-margin, margin:-margin]
    clean = camera.balanced(np.maximum(clean, 0.0))
    lens = draw_lens(0)  # for the file's metadata alone
    settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
    truth = Truth(lens, camera, settings, "", 1.0, BlurOptions(), 0)
    sharp = camera.balanced(sharp)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tiles.dng"
        write_photo(path, SimulatedPhoto(camera.mosaic(clean, rng), clean, clean, sharp, truth))
        return TilePhoto(photo.develop(path), sharp)


def widened(kernel: Kernel, factor: float) -> Kernel:
    """Kernel of `factor` times the width."""
    middle = kernel.shape[0] // 2
    t = (np.arange(kernel.shape[0]) - middle) / factor + middle
    where = np.meshgrid(t, t, indexing="ij")
    return centred(np.maximum(ndimage.map_coordinates(kernel, where, order=3), 0.0))


def spoiled(kernels: Sequence[Kernels], kind: str) -> list[Kernels]:
    """What a model learns from instead of the truth."""
    how, _, where = kind.partition(" ")
    xy = np.array([(p.r * math.cos(p.phi), p.r * math.sin(p.phi)) for p in PLACES])
    found: list[Kernels] = []
    for place, at, known in zip(PLACES, xy, kernels, strict=True):
        if how == "right" or (where and not 0.0 <= place.phi < math.pi / 2.0):
            found.append(known)
        elif how == "displaced":
            away = at + np.array([0.5 if at[0] < 0.2 else -0.5, 0.0])
            found.append(kernels[int(((xy - away) ** 2).sum(axis=1).argmin())])
        elif how == "turned":
            found.append({c: centred(np.rot90(kernel)) for c, kernel in known.items()})
        else:
            found.append({c: widened(kernel, float(how[1:])) for c, kernel in known.items()})
    return found


def outcome(
    truth: Sequence[Kernels], shots: Sequence[TilePhoto], kind: str, settings: LensSettings
) -> NDArray[np.float64]:
    """Gains of some tiles of the last photo without and with witnesses, shape (tiles, 2)."""
    green, pitch = settings.with_channel("g"), SimulatedCamera().pitch_um
    kernels = spoiled(truth, kind)
    samples = [
        PsfSample(
            kernel=resized(kernels[number][channel], 41),
            position=place,
            settings=settings.with_channel(channel),
            weight=1.0 / 3.0,
            photo=f"{shot_number}",
            error=ERROR,
            pixel_pitch_um=pitch,
            spectrum=shot.spectrum(number, channel, kernels[number][channel]),
        )
        for shot_number, shot in enumerate(shots[:-1])
        for number, place in enumerate(PLACES)
        for channel in CHANNELS
    ]
    model = LensModel.fit(samples)
    own = [
        PsfSample(
            delta(41),
            place,
            green,
            pixel_pitch_um=pitch,
            spectrum=shots[-1].spectrum(number, "g", kernels[number]["g"]),
        )
        for number, place in enumerate(PLACES)
    ]
    field, gains = WitnessedField.of(model.warmed(), settings, own), []
    for number in ASKED[:NEAR_QUARTER] if kind.endswith("quarter") else ASKED:
        place = PLACES[number]
        plain: Kernels = {}
        errors: dict[Channel, float] = {}
        for channel in CHANNELS:
            answer = model.query(place, settings.with_channel(channel), SIZE)
            plain[channel], errors[channel] = answer.kernel, answer.predicted_error
        pair = ByChannel(plain, errors), OfPlace(field, place)
        gains.append(tuple(shots[-1].gain(number, one) for one in pair))
    return np.array(gains)


def lenses(wanted: argparse.Namespace) -> list[tuple[str, int, PsfField, LensSettings]]:
    """Names, seeds and fields of the lenses."""
    first, last = (int(text) for text in wanted.seeds.split(":"))
    found: list[tuple[str, int, PsfField, LensSettings]] = []
    for seed in range(first, last):
        lens = draw_lens(seed)
        settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
        found.append((f"{seed}", seed, SimulatedField(lens, settings), settings))
    if wanted.grids:
        from lensmodel.lab.traced import read_grid  # noqa: PLC0415 - simulated lenses need none

        for number, path in enumerate(wanted.grids):
            grid = read_grid(path)
            found.append((path.stem, 1000 + number, grid, LensSettings(aperture=grid.f_number)))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="1000:1008", help="lenses drawn by third-order theory, FIRST:END")
    parser.add_argument("--grids", type=Path, nargs="*", default=[], help="node grids of ray-traced lenses")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    wanted = parser.parse_args()
    every = list_photos(Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp")
    rows: dict[str, list[NDArray[np.float64]]] = {kind: [] for kind in wanted.kinds}
    for name, seed, field, settings in lenses(wanted):
        half = "dev" if seed < 1000 else "test"
        files = [path for path in every if photo_half(path.stem) == half]
        truth = [{c: field.kernel_at(place, c, SIZE) for c in CHANNELS} for place in PLACES]
        rng = np.random.default_rng(seed)
        shots = [shoot(truth, files, rng) for _ in range(3)]
        for kind in wanted.kinds:
            rows[kind].append(outcome(truth, shots, kind, settings))
            pairs = ", ".join(f"{before:.2f} -> {after:.2f}" for before, after in rows[kind][-1])
            print(f"{name}, {kind}: {pairs}", flush=True)
    print("| kernels | tiles | lose 0.3 dB | still lose 0.3 | still lose 0.05 | gain kept |")
    print("|---|---|---|---|---|---|")
    for kind, found in rows.items():
        before, after = np.concatenate(found).T
        lost = before <= -LOSS
        kept = f"{after.sum() / before.sum():.1%}" if kind == "right" else ""
        print(
            f"| {kind} | {len(before)} | {lost.sum()} | {(after[lost] <= -LOSS).sum()} | "
            f"{(after[lost] <= -LEAST).sum()} | {kept} |"
        )


if __name__ == "__main__":
    main()
