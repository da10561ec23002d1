r"""What blind kernels are worth for the corrected photo, and how well the default predicts its error.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.blind.default_estimator \
        [--cases 100] [--half dev] [--shrink 2]

Every case is a simulated lens (generator seeds 0 to 99) at a random place of its field, one to four
windows of one photograph and a random noise level. Each kernel restores the first window with the
standard method; its gain over the blurred window is the judge, in decibels of the sRGB-like picture.
`--shrink` reduces the photographs first, which makes their scenes sharper than cameras see them. The last
lines fit the constants of `predicted_error` to the dev half; they are in-sample there.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy import stats

from lensmodel import quality
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import distance, resized, rms_width
from lensmodel.core.types import FieldPosition, Kernel, LensSettings, NoiseModel, Plane, Planes
from lensmodel.correction import Sensor, SparseGradient
from lensmodel.correction.blur import UniformBlur
from lensmodel.lab import cases
from lensmodel.lab.blind.methods import compared
from lensmodel.lab.cases import BlindCase, Half
from lensmodel.simulate import draw_lens, load_scene

TRUTH = "true kernel"
METHODS = ("whittle", "polyblur", "edges", "michaeli-irani", "default")
SIZE = 31  # pixels: that of an estimate
WIDTHS_PX = (0.3, 4.5)  # RMS widths that occur (chosen)


def kernels(rng: np.random.Generator) -> Kernel:
    """One PSF of a random lens, place and pixel pitch, between the widths that occur."""
    while True:
        lens = draw_lens(int(rng.integers(100)))
        place = FieldPosition(float(np.sqrt(rng.uniform())), float(rng.uniform(-np.pi, np.pi)))
        settings = LensSettings(aperture=lens.at_focal().f_number)
        kernel = lens.kernel(place, settings, 55, pitch_um=float(rng.choice([3.8, 4.5, 6.0, 9.0])))
        if WIDTHS_PX[0] < rms_width(kernel) < WIDTHS_PX[1]:
            return kernel


def shrunk(path: Path, factor: int) -> Planes:
    """A photograph in linear light, `factor` times smaller by means over blocks, bright parts at 0.9."""
    planes = load_scene(path)
    h, w = (n // factor * factor for n in planes.shape[1:])
    small = planes[:, :h, :w].reshape(3, h // factor, factor, w // factor, factor).mean(axis=(2, 4))
    return np.minimum(small * (0.9 / np.percentile(small[1], 99.5)), 1.0).astype(np.float32)


def gain(plane: Plane, sharp: Plane, kernel: Kernel, noise: NoiseModel) -> float:
    """Decibels that restoring with `kernel` wins over the blurred window."""

    def psnr(shown: Plane) -> float:
        a, b = np.maximum(shown, 0.0)[None] ** (1 / 2.2), sharp[None] ** (1 / 2.2)
        shift = quality.best_shift(a, b)
        a = quality.shifted(a, *shift) if max(map(abs, shift)) < 3 else a
        return float(-10 * np.log10(np.mean((a - b)[:, 16:-16, 16:-16] ** 2)))

    restored = SparseGradient().deconvolve(plane, UniformBlur(kernel), sensor=Sensor(noise)).plane
    return psnr(restored) - psnr(plane)


def rows(
    half: Half, count: int, photos: list[Path], methods: tuple[str, ...]
) -> Iterator[dict[str, list[float]]]:
    """Per case and method: gain, relative L2, MTF error, width ratio, true width; features of the default."""
    for turn in range(count):
        rng = np.random.default_rng([turn, half == "dev"])
        kernel = kernels(rng)
        level, size = float(np.exp(rng.uniform(np.log(0.002), np.log(0.025)))), int(rng.choice([128, 192]))
        photo, pool = photos[int(rng.integers(len(photos)))], int(rng.choice([1, 1, 2, 4]))
        variant = str(rng.choice(["gaussian", "gaussian", "bayer"]))
        seen = [
            cases.observe(
                BlindCase((photo,), 0, level, size, "bayer" if variant == "bayer" else "gaussian", s), kernel
            )
            for s in rng.integers(1 << 30, size=pool).tolist()
        ]
        noise, found = NoiseModel.white(level), {}
        for name in (TRUTH, *methods):
            try:
                estimate = resized(kernel, SIZE)
                if name != TRUTH:
                    answer = compared.create(name).estimate(
                        [s.patches[0] for s in seen], [noise] * pool, size=SIZE
                    )
                    estimate = answer.kernel
            except LensModelError as error:
                print(f"case {turn}, {name}: {error}", file=sys.stderr)
                found[name] = [0.0, 1.0, 1.0, 0.0, rms_width(kernel)]  # the photo stays as it was
                continue
            off = distance(estimate, kernel)
            found[name] = [
                gain(seen[0].patches[0], seen[0].sharp, estimate, noise),
                off.rel_l2,
                off.mtf_rmse,
                rms_width(estimate) / rms_width(kernel),
                rms_width(kernel),
            ]
            if name == "default":
                d = answer.diagnostics
                found["features"] = [
                    d["apart"],
                    d["disagreement"],
                    d["gaussian_width"],
                    d["slope"],
                    answer.predicted_error,
                ]
        if "features" in found:
            yield found
        print(f"\r{turn + 1} of {count}", end="", file=sys.stderr)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--half", choices=("dev", "test"), default="dev")
    parser.add_argument("--shrink", type=int, default=1)
    parser.add_argument(
        "--methods", default=",".join(METHODS), help="with commas between; default is among them"
    )
    asked = parser.parse_args()
    if asked.shrink > 1:
        cases.scene_of = lambda path: shrunk(path, asked.shrink)  # type: ignore[assignment]
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    photos = list(cases.list_photos(Path(folder) / "sharp" if folder else None))
    photos = [p for p in photos if cases.photo_half(p.stem) == asked.half]
    methods = tuple(asked.methods.split(","))
    found = list(rows(asked.half, asked.cases, photos, methods))
    print(f"\n{len(found)} cases, half {asked.half}, photographs shrunk {asked.shrink} times")
    print(
        "| kernel | mean gain dB | median | better | worse by 0.5 dB | rel L2 | MTF error | width est/true |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in (TRUTH, *methods):
        v = np.array([f[name] for f in found])
        print(
            f"| {name} | {v[:, 0].mean():+.2f} | {np.median(v[:, 0]):+.2f} | {(v[:, 0] > 0).mean():.0%} "
            f"| {(v[:, 0] < -0.5).mean():.0%} | {np.median(v[:, 1]):.2f} | {np.median(v[:, 2]):.3f} "
            f"| {np.median(v[:, 3]):.2f} |"
        )
    features, error = np.array([f["features"] for f in found]), np.array([f["default"][1] for f in found])
    rank = stats.spearmanr(features[:, 4], error).statistic
    print(f"predicted against true error of the default: Spearman {rank:.2f}")
    design = np.stack(
        [
            np.ones(len(error)),
            np.log(np.maximum(features[:, 0], 1e-3)),
            features[:, 1],
            np.log(np.maximum(features[:, 2], 0.2)),
            features[:, 3] - 2.5,
        ],
        axis=1,
    )
    fit = np.linalg.lstsq(design, np.log(error), rcond=None)[0]
    print("constants of predicted_error fitted to these cases:", np.round(fit, 2))


if __name__ == "__main__":
    main()
