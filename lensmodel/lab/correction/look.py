"""Crops at 1:1 for the eye: what a correction did to a chart, lamps at night, skin and sky, and real photos.

    python -m lensmodel.lab.correction.look --out FOLDER [--kind soft-fast] [--seed 1000] [--photo PHOTO]

Writes one PNG for each scene, exposure and place, center and extreme corner of a frame of 6 megapixels: the
scene, the photo of it, and what each method makes of that with the true PSF field, below each other. Of
`--photo` it writes five places instead, photo and results side by side, with a made-up Gaussian of 0.8 pixels
in the center and 1.15 in the corner and an error of 0.4, as of profiles that say nothing of themselves.

For each it prints the standard deviation of flat places after over before, and by how much the result leaves
the range of the scene (of the photo, where there is no scene) within 2 pixels, 99.9th percentile in percent.
Look at the pictures: figures know nothing of seams.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lensmodel.core.types import LensSettings, Planes
from lensmodel.correction import Roi, correct_planes
from lensmodel.lab.correction.correction_benchmark import SoftCorners
from lensmodel.lab.correction.quality import EXPOSURES, WINDOW, corrected, exposed, view
from lensmodel.photo import develop
from lensmodel.report.photo_crops import as_shown, crop_boxes
from lensmodel.simulate import draw_lens

SIZE = tuple(extent + 238 for extent in WINDOW)
"""As large as a window and all around it that the lens draws light from."""
OVER = 3  # samples a pixel along each axis (chosen)
CROP = 360  # pixels that are shown (chosen)
ERROR = 0.4  # expected of the PSF (chosen): usual after one photo
FLAT = 12  # pixels of the squares that grain is measured in (chosen)


def chart() -> Planes:
    """A star of 36 spokes, and squares that are a little turned, of three contrasts."""
    rows, cols = np.mgrid[: OVER * SIZE[0], : OVER * SIZE[1]].astype(np.float32) / OVER
    light = np.full(rows.shape, 0.45, dtype=np.float32)
    y, x = rows - SIZE[0] / 2, cols - SIZE[1] * 0.36
    star = np.hypot(y, x) < 120
    light[star] = np.where(np.sin(36 * np.arctan2(y[star], x[star])) > 0, 0.8, 0.05)
    for number, (dark, bright) in enumerate(((0.02, 0.9), (0.15, 0.75), (0.4, 0.5))):
        v, u = rows - SIZE[0] * (0.3 + 0.2 * number), cols - SIZE[1] * 0.72
        u, v = u + 0.1 * v, v - 0.1 * u
        light[(abs(u) < 45) & (abs(v) < 45)] = dark
        light[(abs(u) < 30) & (abs(v) < 30)] = bright
    return np.stack([_reduced(light)] * 3)


def night() -> Planes:
    """Lamps of 1.5 to 60 times saturation and of 1 to 6 pixels before dark facades and an evening sky."""
    rng = np.random.default_rng(3)
    rows, cols = np.mgrid[: OVER * SIZE[0], : OVER * SIZE[1]].astype(np.float32) / OVER
    light = np.empty((3, *rows.shape), dtype=np.float32)
    for c, sky in enumerate((0.06, 0.09, 0.16)):
        light[c] = sky * (0.6 + 0.8 * rows / SIZE[0])
    for left in range(0, SIZE[1], 90):
        top = rng.uniform(0.35, 0.6) * SIZE[0]
        house = (rows > top) & (cols >= left) & (cols < left + 80)
        windows = house & (rows % 18 < 9) & ((cols - left) % 14 < 7)
        lit = rng.random((60, 60)) < 0.3
        lit = lit[np.minimum(rows // 18, 59).astype(int), np.minimum(cols // 14, 59).astype(int)]
        light[:, house] = 0.01
        light[:, windows & lit] = np.array([0.7, 0.45, 0.2], dtype=np.float32)[:, None] * rng.uniform(
            0.3, 2.0
        )
    for number in range(36):
        y, x = rng.uniform(0.2, 0.8) * SIZE[0], rng.uniform(0.2, 0.8) * SIZE[1]
        colour = np.array([1.0, rng.uniform(0.6, 1.0), rng.uniform(0.3, 1.0)], dtype=np.float32)
        lamp = np.hypot(rows - y, cols - x) < (1, 2, 3, 6)[number % 4]
        light[:, lamp] = colour[:, None] * (1.5, 5.0, 20.0, 60.0)[number // 4 % 4]
    return np.stack([_reduced(plane) for plane in light])


def portrait() -> Planes:
    """Skin with pores, brow and hair to the left, a sky that fades to the right; smooth above all."""
    rng = np.random.default_rng(4)
    rows, cols = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    shade = 1.0 + 0.15 * _field(rng, 40.0) + 0.02 * _field(rng, 1.2)
    light = np.stack([level * shade for level in (0.55, 0.33, 0.24)])
    sky = cols > SIZE[1] * 0.52 + 30 * np.sin(rows / 60.0)
    for c, (top, bottom) in enumerate(((0.18, 0.5), (0.32, 0.6), (0.62, 0.75))):
        light[c] = np.where(sky, top + (bottom - top) * rows / SIZE[0], light[c])
    hair = np.zeros(SIZE, dtype=np.float32)
    for _ in range(500):
        at = (
            SIZE[1] * 0.52
            + rng.normal(0, 12)
            + 30 * np.sin(rows[:, 0] / 60.0)
            + rng.normal(0, 0.15) * rows[:, 0]
        )
        hair += np.clip(1.0 - abs(cols - at[:, None]), 0.0, 1.0) * 0.35
    brow = (abs(rows - SIZE[0] * 0.4 - 0.002 * (cols - SIZE[1] * 0.36) ** 2) < 7) & (
        abs(cols - SIZE[1] * 0.36) < 60
    )
    hair += brow * (rng.random(SIZE) < 0.5)
    share = np.minimum(ndimage.gaussian_filter(hair, 0.5), 1.0)
    dark = np.array([0.05, 0.035, 0.03], dtype=np.float32)[:, None, None]
    return np.asarray(light * (1 - share) + dark * share, dtype=np.float32)


SCENES = {"chart": chart, "night": night, "portrait": portrait}


def _reduced(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over what one pixel sees."""
    return plane.reshape(SIZE[0], OVER, SIZE[1], OVER).mean(axis=(1, 3), dtype=np.float32)


def _field(rng: np.random.Generator, width: float) -> NDArray[np.float32]:
    """A smooth random plane of unit variance."""
    plane = ndimage.gaussian_filter(rng.standard_normal(SIZE), width, mode="wrap")
    return np.asarray(plane / plane.std(), dtype=np.float32)


def figures(after: Planes, before: Planes, range_of: Planes) -> str:
    """Grain of flat places after over before in shown codes, and how far the range is left, in words."""
    shown, was, real = (
        as_shown(planes).astype(np.float32).mean(axis=2) for planes in (after, before, range_of)
    )
    cells = [
        (slice(row, row + FLAT), slice(col, col + FLAT))
        for row in range(0, was.shape[0] - FLAT + 1, FLAT)
        for col in range(0, was.shape[1] - FLAT + 1, FLAT)
    ]
    texture = [float(ndimage.gaussian_filter(was[cell], 2.0).std()) for cell in cells]
    flat = [
        cells[i] for i in np.argsort(texture)[: max(4, len(cells) // 10)] if 4 < was[cells[i]].mean() < 250
    ]
    grain = [
        np.median([picture[cell].std() for cell in flat]) if flat else np.nan for picture in (was, shown)
    ]
    low, high = ndimage.minimum_filter(real, 5), ndimage.maximum_filter(real, 5)
    beyond = np.maximum(shown - high, low - shown) / 2.55
    return (
        f"grain {grain[0]:.2f} -> {grain[1]:.2f} codes, beyond the range {np.quantile(beyond, 0.999):.1f} %"
    )


def look_at_scenes(folder: Path, kind: str, seed: int, methods: list[str], names: list[str]) -> None:
    """Photograph each scene in the center and in the extreme corner, at both exposures."""
    field = draw_lens(seed, kind).field(LensSettings())
    for name in names:
        scene = SCENES[name]()
        for zone in ("center", "corner"):
            at = view(zone, scene, field)
            for exposure, noise in EXPOSURES.items():
                seen = exposed(at.light, noise, np.random.default_rng(5))
                truth, before = at.inner(at.scene), at.inner(seen)
                results = {method: corrected(seen, at, field, noise, method) for method in methods}
                for method, after in results.items():
                    print(
                        f"{name}, {zone}, {exposure}, {method}: {figures(after, before, truth)}", flush=True
                    )
                sheet = [as_shown(planes) for planes in (truth, before, *results.values())]
                path = folder / f"{name}-{zone}-{exposure.replace(' ', '-')}.png"
                Image.fromarray(np.concatenate(sheet)).save(path)


def look_at_photo(folder: Path, path: Path, methods: list[str]) -> None:
    """Correct five places of a real photo."""
    photo = develop(path)
    lens = SoftCorners(0.8, 1.15)
    for place, (top, left) in crop_boxes(photo.frame.height, photo.frame.width, CROP).items():
        roi = Roi(top, left, CROP, CROP)
        before = np.asarray(photo.planes[:, top : top + CROP, left : left + CROP])
        sheet = [as_shown(before, photo.white_balance)]
        for method in methods:
            after = correct_planes(
                photo.planes,
                lens,
                photo.frame,
                noise=photo.correction_noise,
                clip=photo.clip,
                psf_error=ERROR,
                cfa=photo.cfa,
                method=method,
                roi=roi,
            ).planes
            print(f"{path.stem}, {place}, {method}: {figures(after, before, before)}", flush=True)
            sheet.append(as_shown(after, photo.white_balance))
        target = folder / f"{path.stem}-{place.replace(' ', '-')}.png"
        Image.fromarray(np.concatenate(sheet, axis=1)).save(target)


def main() -> None:
    """Write the crops and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kind", default="soft-fast")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--methods", nargs="+", default=["standard", "fast"])
    parser.add_argument("--scenes", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--photo", type=Path, nargs="*", default=[])
    wanted = parser.parse_args()
    wanted.out.mkdir(parents=True, exist_ok=True)
    look_at_scenes(wanted.out, wanted.kind, wanted.seed, wanted.methods, wanted.scenes)
    for path in wanted.photo:
        look_at_photo(wanted.out, path, wanted.methods)


if __name__ == "__main__":
    main()
