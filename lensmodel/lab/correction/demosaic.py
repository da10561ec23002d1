"""What the choice of demosaicing does to PSFs and to corrections; prints the table of docs/lab/correction.md.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.demosaic [--seeds 0 1 2] [--electrons 20000]

Each seed draws a lens and takes a photo of a known scene as a Bayer DNG of 0.4 megapixels, developed by every
method. The PSF is what a least-squares fit with the true scene finds in a window of each zone: nothing but
demosaicing and noise can make it wrong. The correction is `standard` with the true PSF field; gains are in
dB of the sRGB picture over AHD, uncorrected, in center, mid and corner. "own green" takes nothing but
the sensor's green pixels, "joint" is how RAW files are corrected: it demosaics and deblurs in one.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel import photo
from lensmodel.core.psf import PsfField, as_kernel, distance
from lensmodel.core.types import CHANNELS, ZONES, Channel, LensSettings, Plane, Planes
from lensmodel.correction import Sensor, SparseGradient, correct_planes
from lensmodel.correction.blur import UniformBlur, crop_to_support
from lensmodel.lab.images import psnr
from lensmodel.photo import Demosaic, LinearPhoto
from lensmodel.simulate import (
    LENS_KINDS,
    BlurOptions,
    SimulatedCamera,
    SimulatedLens,
    SimulatedPhoto,
    draw_lens,
    load_scene,
    photograph,
    write_photo,
)

PITCH_UM: Final = 6.0  # of the camera (chosen)
SIDE, KERNEL, RIM = 144, 21, 12  # pixels of a window, a fitted kernel, the rim that is not judged (chosen)
CORNERS: Final = {"center": (184, 312), "mid": (60, 150), "corner": (14, 14)}
"""First pixels of the windows, even, so that every one begins on the same colour of the mosaic."""
DEMOSAICS: Final[dict[str, Demosaic]] = {"ahd": "ahd", "dht": "dht", "linear": "linear", "half": "half"}
ROUTES: Final = ("ahd", "dht", "linear", "half", "own green", "joint")


@dataclass(frozen=True, slots=True)
class MosaicPhoto:
    """One photo, its file and its lens."""

    shot: SimulatedPhoto
    path: Path
    lens: SimulatedLens
    settings: LensSettings

    def field(self, scale: int) -> PsfField:
        """Its true PSF field, in pixels `scale` times as large."""
        return self.lens.field(self.settings, pitch_um=scale * PITCH_UM)


def shots(seeds: list[int], electrons: float, folder: Path) -> Iterator[MosaicPhoto]:
    """Take the photos."""
    files = sorted((Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp").glob("*.png"))
    camera = SimulatedCamera(height=512, width=768, pitch_um=PITCH_UM, full_well_electrons=electrons)
    for seed in seeds:
        lens = draw_lens(seed, LENS_KINDS[seed % len(LENS_KINDS)])
        settings = LensSettings(aperture=lens.at_focal().f_number)
        scene = load_scene(files[(7 * seed + 3) % len(files)])
        top, left = (
            (extent - size - 64) // 2 for extent, size in zip(scene.shape[1:], (512, 768), strict=True)
        )
        part = np.ascontiguousarray(scene[:, top : top + 576, left : left + 832])
        options = BlurOptions(pitch_um=PITCH_UM, step=0.1, size=41, lateral=False)
        shot = photograph(part, lens, settings, camera, np.random.default_rng(seed), options=options)
        path = folder / f"{seed}.dng"
        write_photo(path, shot)
        yield MosaicPhoto(shot, path, lens, settings)


def kernel_of(sharp: Plane, seen: Plane, known: NDArray[np.bool_], size: int) -> NDArray[np.float64]:
    """Kernel that takes the true scene to what was seen, by least squares over the known pixels."""
    half = size // 2
    views = np.lib.stride_tricks.sliding_window_view(sharp, (size, size))
    inner = known[half:-half, half:-half]
    rows = views[inner][:, ::-1, ::-1].reshape(-1, size * size).astype(np.float32)
    data = seen[half:-half, half:-half][inner].astype(np.float32)
    normal = (rows.T @ rows).astype(np.float64)
    normal += np.eye(len(normal)) * 1e-4 * np.trace(normal) / len(normal)
    found = np.linalg.solve(normal, rows.T.astype(np.float64) @ data)
    return as_kernel(np.maximum(found.reshape(size, size), 0.0))


def binned(planes: Planes) -> Planes:
    """What a half-size development sees: red and blue of one pixel in four, green of two."""
    green = 0.5 * (planes[1, ::2, 1::2] + planes[1, 1::2, ::2])
    return np.stack([planes[0, ::2, ::2], green, planes[2, 1::2, 1::2]])


def developed(one: MosaicPhoto, route: str) -> LinearPhoto:
    """The photo as a route takes it."""
    return photo.develop(one.path, demosaic=DEMOSAICS.get(route, "ahd"))


def measured(seen: LinearPhoto) -> NDArray[np.intp]:
    """Which colour the sensor measured at each pixel."""
    rows, cols = (np.arange(extent) % 2 for extent in (seen.frame.height, seen.frame.width))
    return np.asarray(seen.cfa)[rows[:, None], cols[None, :]]


def psf_errors(one: MosaicPhoto, route: str, seen: LinearPhoto) -> dict[tuple[str, Channel], float]:
    """Relative L2 error of the kernels that a window of each zone shows."""
    scale = 2 if route == "half" else 1
    sharp = binned(one.shot.sharp) if scale == 2 else one.shot.sharp
    side, size = SIDE // scale, KERNEL // scale // 2 * 2 + 1
    everywhere = np.ones(sharp.shape[1:], dtype=np.bool_)
    sites = measured(seen) if route in {"own green", "joint"} else None
    found: dict[tuple[str, Channel], float] = {}
    for zone, corner in CORNERS.items():
        top, left = (at // scale for at in corner)
        window = slice(top, top + side), slice(left, left + side)
        place = seen.frame.position(top + (side - 1) / 2, left + (side - 1) / 2)
        for c, channel in enumerate(CHANNELS):
            if route == "own green" and channel != "g":
                continue
            known = everywhere if sites is None else sites == c
            kernel = kernel_of(sharp[c][window], seen.planes[c][window], known[window], size)
            found[zone, channel] = distance(kernel, one.field(scale).kernel_at(place, channel, 41)).rel_l2
    return found


def own_green(one: MosaicPhoto, seen: LinearPhoto) -> Planes:
    """Correct the green of each zone's window from nothing but the green pixels of the sensor."""
    made = seen.planes.copy()
    noise = (seen.sensor_noise or seen.noise)[1]
    for top, left in CORNERS.values():
        rows = slice(max(top - 2 * KERNEL, 0), top + SIDE + 2 * KERNEL)
        cols = slice(max(left - 2 * KERNEL, 0), left + SIDE + 2 * KERNEL)
        place = seen.frame.position(top + SIDE / 2, left + SIDE / 2)
        blur = UniformBlur(crop_to_support(one.field(1).kernel_at(place, "g", 41)))
        sensor = Sensor(noise, seen.clip[1], measured=measured(seen)[rows, cols] == 1)
        made[1, rows, cols] = (
            SparseGradient().deconvolve(seen.planes[1, rows, cols], blur, sensor=sensor).plane
        )
    return made


def corrected(one: MosaicPhoto, route: str, seen: LinearPhoto) -> Planes:
    """Correct with the true field; a half-size picture is enlarged again."""
    if route == "own green":
        return own_green(one, seen)
    joint = route == "joint"
    noise = seen.sensor_noise if joint and seen.sensor_noise else seen.noise
    scale = 2 if route == "half" else 1
    made = correct_planes(
        seen.planes,
        one.field(scale),
        seen.frame,
        noise=noise,
        clip=seen.clip,
        cfa=seen.cfa if joint else None,
    ).planes
    if scale == 1:
        return made
    wide = np.empty_like(one.shot.sharp)
    rows, cols = np.mgrid[: wide.shape[1], : wide.shape[2]].astype(np.float64)
    for c, (down, across) in enumerate(((0.0, 0.0), (0.5, 0.5), (1.0, 1.0))):
        at = np.stack([(rows - down) / 2.0, (cols - across) / 2.0])
        wide[c] = ndimage.map_coordinates(made[c], at, order=3, mode="nearest")
    return wide


def levels(one: MosaicPhoto, planes: Planes, channels: slice) -> dict[str, float]:
    """PSNR of the white-balanced sRGB picture in the window of each zone."""
    balance = np.asarray(one.shot.truth.camera.white_balance, dtype=np.float32)[:, None, None]
    found = {}
    for zone, (top, left) in CORNERS.items():
        window = (channels, slice(top + RIM, top + SIDE - RIM), slice(left + RIM, left + SIDE - RIM))
        truth, made = (np.clip(p * balance, 0.0, 1.0)[window] for p in (one.shot.sharp, planes))
        found[zone] = psnr(made, truth, srgb=True)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--electrons", type=float, default=20000.0)
    wanted = parser.parse_args()
    errors: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    gains: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        for number, one in enumerate(shots(wanted.seeds, wanted.electrons, Path(name)), start=1):
            plain = developed(one, "ahd").planes
            for route in ROUTES:
                seen = developed(one, route)
                for (zone, channel), error in psf_errors(one, route, seen).items():
                    errors[route, zone, channel].append(error)
                made = corrected(one, route, seen)
                for kind, channels in (("green", slice(1, 2)), ("all", slice(0, 3))):
                    before, after = levels(one, plain, channels), levels(one, made, channels)
                    for zone in ZONES:
                        gains[route, zone, kind].append(after[zone] - before[zone])
            print(f"{number} of {len(wanted.seeds)} photos", flush=True)
    print(
        "\n| route | PSF error, green | red | blue | gain, green | all colours |\n|---|---|---|---|---|---|"
    )
    for route in ROUTES:
        cells = [
            " / ".join(f"{np.mean(errors[route, zone, c]):.2f}" for zone in ZONES)
            if errors[route, "center", c]
            else ""
            for c in ("g", "r", "b")
        ]
        cells += [
            " / ".join(f"{np.mean(gains[route, zone, kind]):+.1f}" for zone in ZONES)
            for kind in ("green", "all")
            if route != "own green" or kind == "green"
        ]
        print(f"| {route} | " + " | ".join(cells + [""] * (5 - len(cells))) + " |")


if __name__ == "__main__":
    main()
