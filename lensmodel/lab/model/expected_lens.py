"""What lenses have of each aberration: the numbers of `lensmodel.optics.aberration_prior`.

    python -m lensmodel.lab.model.expected_lens --seeds 0:60 [--grids FILE.npz ...]

Lenses are drawn, or ray-traced ones (`lensmodel.lab.traced`), whose terms are those of the wavefront that
suits their exact kernels best. Printed for each family are the root mean square and the median of each term
of `wavefront.NAMES`, in pixels of blur at the widest aperture, beside the spreads that the fits expect; mean
and spread of focus over spherical aberration, of ln(s(1) / s(0)) with s(r) the mean width of the rays' spot
at r, and of the two numbers of the cat's eye.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample, as_kernel
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.lab.traced import GridLens
from lensmodel.model.wavefront.from_kernels import fit_wavefront
from lensmodel.optics.aberration_prior import ABERRATIONS, corner_ratio
from lensmodel.optics.wavefront import NAMES
from lensmodel.simulate import Aberrations, draw_lens
from lensmodel.simulate.lens import DEFAULT_PITCH_UM
from lensmodel.simulate.pupil import REFERENCE_UM

_PLACES: Final = 36  # of exact kernels, spread over the field: the fit takes as many
_SIZE: Final = 41  # pixels


def terms_of(optics: Aberrations) -> NDArray[np.float64]:
    """Terms of a simulated lens in the unknowns of the fit, pixels, shape (19,).

    W = sum_k g_k B_k / (2 q), and the field counts from the centre of symmetry: h' = h - decentring.
    """
    scale = 2.0 * REFERENCE_UM * optics.f_number / DEFAULT_PITCH_UM
    x, y = optics.decentring
    coma, astigmatism = optics.coma, optics.astigmatism / 2.0
    curvature = optics.field_curvature + astigmatism
    terms = {
        "spherical": optics.spherical,
        "coma": coma,
        "uniform coma x": optics.uniform_coma[0] - coma * x,
        "uniform coma y": optics.uniform_coma[1] - coma * y,
        "focus": optics.defocus + curvature * (x * x + y * y),
        "tilt x": optics.tilt[0] - 2.0 * curvature * x,
        "tilt y": optics.tilt[1] - 2.0 * curvature * y,
        "field curvature": curvature,
        "colour 1": optics.colour_focus[0],
        "colour 2": optics.colour_focus[1],
        "astigmatism": astigmatism,
        "linear astigmatism 1": -2.0 * astigmatism * x,
        "linear astigmatism 2": -2.0 * astigmatism * y,
        "uniform astigmatism 1": optics.uniform_astigmatism[0] + astigmatism * (x * x - y * y),
        "uniform astigmatism 2": optics.uniform_astigmatism[1] + 2.0 * astigmatism * x * y,
    }
    return scale * np.array([terms.get(name, 0.0) for name in NAMES])


def terms_of_traced(path: Path) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Terms of the wavefront nearest to a ray-traced lens, shape (19,), and its cat's eye."""
    lens = GridLens.read(path)
    field, rng = lens.field(), np.random.default_rng(0)
    settings = LensSettings(aperture=lens.widest(), focal_mm=lens.focal_mm[0])
    samples = []
    for r, phi in zip(0.98 * np.sqrt(rng.random(_PLACES)), rng.uniform(-np.pi, np.pi, _PLACES), strict=True):
        place = FieldPosition(float(r), float(phi))
        for channel in CHANNELS:
            kernel = as_kernel(field.kernel_at(place, channel, _SIZE))
            asked = settings.with_channel(channel)
            samples.append(PsfSample(kernel, place, asked, photo="exact", pixel_pitch_um=field.pitch_um))
    front = fit_wavefront(samples)
    assert front is not None, "there are samples enough"
    return front.terms, front.eye


def print_terms(words: str, terms: NDArray[np.float64], eyes: NDArray[np.float64]) -> None:
    """Print what lenses have, terms of shape (n, 19) and cat's eyes (n, 2)."""
    print(f"\n{len(terms)} {words} lenses; pixels of blur: rms, median, expected with spectra, with kernels")
    usual, middle = np.sqrt((terms**2).mean(axis=0)), np.median(np.abs(terms), axis=0)
    rows = zip(NAMES, usual, middle, ABERRATIONS.with_spectra, ABERRATIONS.with_kernels, strict=True)
    for name, size, median, with_spectra, with_kernels in rows:
        print(f"{name:22} {size:5.2f} {median:5.2f} {with_spectra:5.2f} {with_kernels:5.2f}")
    focus, spherical = terms[:, NAMES.index("focus")], terms[:, NAMES.index("spherical")]
    balanced = np.abs(spherical) > 0.0
    ratios = {
        "focus beyond the balance, px": focus - ABERRATIONS.balance * spherical,
        "focus over spherical": focus[balanced] / spherical[balanced],
        "ln(s(1) / s(0))": np.array([corner_ratio(own)[0] for own in terms]),
        "cat's eye, radius": eyes[:, 0],
        "cat's eye, shift": eyes[:, 1],
    }
    for name, values in ratios.items():
        print(f"{name}: {values.mean():.2f}, spread {values.std():.2f}")


def main() -> None:
    """Draw lenses, read grids, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="0:60", help="first:last lens, the last left out")
    parser.add_argument("--grids", type=Path, nargs="*", default=[], help="ray-traced lenses")
    asked = parser.parse_args()
    first, last = (int(n) for n in asked.seeds.split(":"))
    lenses = [draw_lens(seed).at_focal() for seed in range(first, last)]
    if lenses:
        eyes = np.array([lens.vignetting for lens in lenses])
        print_terms("drawn", np.array([terms_of(lens) for lens in lenses]), eyes)
    if asked.grids:
        terms, eyes = (np.array(part) for part in zip(*map(terms_of_traced, asked.grids), strict=True))
        print_terms("ray-traced", terms, eyes)


if __name__ == "__main__":
    main()
