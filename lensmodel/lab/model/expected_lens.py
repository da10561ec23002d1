"""What simulated lenses have of each aberration: the numbers of `lensmodel.optics.aberration_prior`.

    python -m lensmodel.lab.model.expected_lens --seeds 0:60

Printed are the root mean square of each term of `wavefront.NAMES` over the lenses, in pixels of blur at the
widest aperture, beside the spreads that the fits expect; mean and spread of focus over spherical aberration,
of ln(s(1) / s(0)) with s(r) the mean width of the rays' spot at r, and of the two numbers of the cat's eye.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from lensmodel.optics.aberration_prior import ABERRATIONS, corner_ratio
from lensmodel.optics.wavefront import NAMES
from lensmodel.simulate import Aberrations, draw_lens
from lensmodel.simulate.lens import DEFAULT_PITCH_UM
from lensmodel.simulate.pupil import REFERENCE_UM


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


def main() -> None:
    """Draw lenses and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="0:60", help="first:last lens, the last left out")
    first, last = (int(n) for n in parser.parse_args().seeds.split(":"))
    lenses = [draw_lens(seed).at_focal() for seed in range(first, last)]
    terms = np.array([terms_of(lens) for lens in lenses])
    print(f"{len(lenses)} lenses; pixels of blur: rms, expected with spectra, with kernels")
    usual = np.sqrt((terms**2).mean(axis=0))
    rows = zip(NAMES, usual, ABERRATIONS.with_spectra, ABERRATIONS.with_kernels, strict=True)
    for name, size, with_spectra, with_kernels in rows:
        print(f"{name:22} {size:5.2f} {with_spectra:5.2f} {with_kernels:5.2f}")
    focus, spherical = terms[:, NAMES.index("focus")], terms[:, NAMES.index("spherical")]
    balanced = np.abs(spherical) > 0.0
    ratios = {
        "focus beyond the balance, px": focus - ABERRATIONS.balance * spherical,
        "focus over spherical": focus[balanced] / spherical[balanced],
        "ln(s(1) / s(0))": np.array([corner_ratio(own)[0] for own in terms]),
        "cat's eye, radius": np.array([lens.vignetting[0] for lens in lenses]),
        "cat's eye, shift": np.array([lens.vignetting[1] for lens in lenses]),
    }
    for name, values in ratios.items():
        print(f"{name}: {values.mean():.2f}, spread {values.std():.2f}")


if __name__ == "__main__":
    main()
