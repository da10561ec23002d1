"""Simulated lenses against closed forms of diffraction and of ray optics."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import special

from lab.kernels import distance
from lab.model_benchmark import pixel_to_local
from lensmodel.core.errors import InvalidInputError, UnknownMethodError
from lensmodel.core.psf import centroid, rms_width, second_moments
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.simulate import LENS_KINDS, Aberrations, SimulatedLens, draw_lens
from lensmodel.simulate.lens import PixelOtf, Pupil, pixel_otf

PITCH = 4.5
CENTER = FieldPosition(0.0, 0.0)
ANGLES = (0.0, 0.7, 1.9, -2.6, -1.2)


def lens(**terms: object) -> SimulatedLens:
    return SimulatedLens((Aberrations(**terms),))  # type: ignore[arg-type]


def diffraction_mtf(frequency: NDArray[np.float64], cutoff: float) -> NDArray[np.float64]:
    """Goodman, Introduction to Fourier Optics, eq. 6-31."""
    x = np.clip(frequency / cutoff, 0.0, 1.0)
    return 2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x * x))


def otf_of(f_number: float, wavelength_um: float, size: int = 55, **terms: object) -> PixelOtf:
    optics = Aberrations(f_number=f_number, **terms)  # type: ignore[arg-type]
    pupil = Pupil.of(optics, (0.0, 0.0), f_number)
    return pixel_otf(pupil, [(wavelength_um, 1.0)], size=size, pitch_um=PITCH, f_number=f_number)


def third_moment(kernel: Kernel, phi: float) -> tuple[float, float]:
    """Third moment of a centred kernel along u and along v, within its core."""
    kernel = np.where(kernel > 0.01 * kernel.max(), kernel, 0.0)
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    u, v = pixel_to_local(t[:, None], t[None, :], phi)
    return float((kernel * u**3).sum()), float((kernel * v**3).sum())


@pytest.mark.parametrize(("f_number", "size"), [(2.8, 101), (4.0, 151), (11.0, 151)])
def test_transfer_function_of_a_perfect_lens_is_the_closed_form(f_number: float, size: int) -> None:
    wave = 0.54
    otf = otf_of(f_number, wave, size)
    frequency = np.arange(otf.values.shape[1]) / otf.period
    wanted = diffraction_mtf(frequency, PITCH / (wave * f_number)) * np.sinc(frequency)

    assert np.abs(otf.values[0].real - wanted)[1:].max() < 1.5e-3
    assert 0.99 < otf.values[0, 0].real < 1.0  # diffraction throws light beyond any finite array
    assert np.abs(otf.values[0].imag).max() < 1e-5


def test_light_inside_the_kernel_is_the_encircled_energy_of_theory() -> None:
    # Rayleigh: E(radius) = 1 - J0(x)^2 - J1(x)^2 with x = pi radius / (lambda N)
    f_number, wave, size = 16.0, 0.54, 31
    light = otf_of(f_number, wave, 201).kernel(size)
    t = np.arange(size) - size // 2
    radius = 10.0
    inside = float(light[np.hypot(t[:, None], t[None, :]) <= radius].sum())
    x = np.pi * radius * PITCH / (wave * f_number)

    assert inside == pytest.approx(1.0 - special.j0(x) ** 2 - special.j1(x) ** 2, abs=4e-3)


def test_half_a_wave_of_defocus_makes_the_strehl_ratio_of_theory() -> None:
    # on the axis of a defocused lens I / I0 = sinc^2(W020), whatever the aperture
    peak = {}
    for w in (0.0, 0.5):
        otf = otf_of(16.0, 0.54, defocus=w)
        row_f = np.fft.fftfreq(otf.values.shape[0], 1.0 / otf.values.shape[0]) / otf.period
        col_f = np.arange(otf.values.shape[1]) / otf.period
        pixel = np.sinc(row_f)[:, None] * np.sinc(col_f)[None, :]
        bare = otf.values.real / np.where(np.abs(pixel) > 1e-3, pixel, 1.0)
        peak[w] = bare[:, 0].sum() + 2.0 * bare[:, 1:].sum()

    assert peak[0.5] / peak[0.0] == pytest.approx(np.sinc(0.5) ** 2, rel=0.01)


def test_kernel_is_normalised_non_negative_and_centred() -> None:
    for kind in LENS_KINDS:
        kernel = draw_lens(3, kind).kernel(FieldPosition(0.8, 0.6), size=41)

        assert kernel.sum() == pytest.approx(1.0)
        assert kernel.min() >= 0.0
        assert max(map(abs, centroid(kernel))) < 1e-3


def test_width_of_a_defocused_point_is_that_of_the_ray_cone() -> None:
    # blur disc of radius 4 lambda N W020; rms width per axis = radius / 2
    f_number, waves = 2.0, 4.0
    kernel = lens(f_number=f_number, defocus=waves).kernel(CENTER)
    radius_px = 4.0 * 0.54 * f_number * waves / PITCH

    assert rms_width(kernel) == pytest.approx(math.hypot(radius_px / 2.0, math.sqrt(1 / 12)), rel=0.04)


@pytest.mark.parametrize(
    ("terms", "r", "phi"),
    [
        *(({"coma": 9.0}, 0.9, phi) for phi in ANGLES),
        ({"uniform_coma": (9.0, 0.0)}, 0.0, 0.0),
        ({"uniform_coma": (0.0, 9.0)}, 0.0, math.pi / 2),  # u of phi = pi/2 points towards row 0
    ],
)
def test_positive_coma_throws_light_outwards_and_uniform_coma_as_named(
    terms: dict[str, object], r: float, phi: float
) -> None:
    kernel = lens(f_number=2.0, **terms).kernel(FieldPosition(r, phi), size=41)
    along_u, along_v = third_moment(kernel, phi)

    assert along_u > 1.0
    assert abs(along_v) < 0.05 * along_u


@pytest.mark.parametrize("phi", ANGLES)
def test_astigmatism_stretches_along_u_at_every_angle(phi: float) -> None:
    kernel = lens(f_number=2.8, astigmatism=2.5).kernel(FieldPosition(0.9, phi), size=41)
    rr, rc, cc = (second_moments(kernel)[i] for i in ((0, 0), (0, 1), (1, 1)))
    c, s = math.cos(phi), math.sin(phi)
    along_u = cc * c * c - 2 * rc * c * s + rr * s * s  # rows grow downwards
    along_v = cc * s * s + 2 * rc * c * s + rr * c * c

    assert along_u > 3.0 * along_v


@given(phi=st.sampled_from(ANGLES), r=st.sampled_from([0.3, 0.8]))
@settings(max_examples=6, deadline=None)
def test_a_quarter_turn_of_the_field_turns_the_kernel(phi: float, r: float) -> None:
    centred_lens = lens(f_number=2.8, coma=2.0, astigmatism=1.0, spherical=0.5, vignetting=(1.1, 0.3))
    kernel = centred_lens.kernel(FieldPosition(r, phi), size=31)
    turned = centred_lens.kernel(FieldPosition(r, phi + math.pi / 2), size=31)

    # each is centred to 5e-4 px; a kernel turned the wrong way differs by far more
    assert np.linalg.norm(np.rot90(kernel) - turned) < 2e-3 * np.linalg.norm(turned)
    assert np.linalg.norm(np.rot90(kernel, -1) - turned) > 0.1 * np.linalg.norm(turned)


def test_decentring_moves_the_place_of_symmetry() -> None:
    shifted = lens(f_number=2.0, coma=3.0, field_curvature=2.0, decentring=(0.3, -0.2))
    r, phi = math.hypot(0.3, 0.2), math.atan2(-0.2, 0.3)
    clean = lens(f_number=2.0).kernel(CENTER, size=31)

    assert distance(shifted.kernel(FieldPosition(r, phi), size=31), clean).rel_l2 < 1e-3
    assert distance(shifted.kernel(CENTER, size=31), clean).rel_l2 > 0.1


def test_tilt_blurs_the_side_that_it_names() -> None:
    tilted = lens(f_number=2.0, defocus=1.0, tilt=(2.0, 0.0))
    right = rms_width(tilted.kernel(FieldPosition(0.8, 0.0), size=41))
    left = rms_width(tilted.kernel(FieldPosition(0.8, math.pi), size=41))

    assert right > 2.0 * left


@pytest.mark.parametrize("kind", LENS_KINDS)
def test_stopping_down_sharpens_until_diffraction(kind: str) -> None:
    drawn = draw_lens(5, kind)
    widths = [
        rms_width(
            drawn.kernel(FieldPosition(0.9, 0.5), LensSettings(aperture=n, focal_mm=drawn.focal_mm[-1]))
        )
        for n in (drawn.optics[0].f_number, 8.0, 16.0, 32.0)
    ]

    assert widths[1] < widths[0]
    assert widths[3] > 1.5 * widths[2]


def test_stopped_down_wavefront_is_the_inner_part_of_the_open_one() -> None:
    optics = Aberrations(
        f_number=2.0, spherical=2.0, coma=1.0, astigmatism=0.7, defocus=-1.0, tilt=(0.2, 0.1)
    )
    h = (0.5, -0.4)
    open_wave = Pupil.of(optics, h, 2.0).wavefront
    closed = Pupil.of(optics, h, 4.0).wavefront
    px = np.linspace(-1, 1, 9, dtype=np.float32)[None, :]
    py = np.linspace(-1, 1, 7, dtype=np.float32)[:, None]

    np.testing.assert_allclose(closed(px, py, 0.6), open_wave(px / 2, py / 2, 0.6), atol=1e-5)


def test_ray_gradient_is_the_derivative_of_the_wavefront() -> None:
    optics = Aberrations(
        f_number=2.0, spherical=2.0, coma=1.5, astigmatism=0.7, uniform_astigmatism=(0.3, 0.4)
    )
    pupil = Pupil.of(optics, (0.6, 0.3), 2.0)
    x, y, e = 0.4, -0.3, 1e-3

    def w(px: float, py: float) -> float:
        return float(pupil.wavefront(np.float64(px), np.float64(py), 0.54))  # type: ignore[arg-type]

    gx, gy = pupil.gradient(np.float64(x), np.float64(y), 0.54)  # type: ignore[arg-type]
    assert gx == pytest.approx((w(x + e, y) - w(x - e, y)) / (2 * e), rel=1e-3)
    assert gy == pytest.approx((w(x, y + e) - w(x, y - e)) / (2 * e), rel=1e-3)


def test_longitudinal_colour_blurs_blue_when_green_is_in_focus() -> None:
    coloured = lens(f_number=2.0, colour_focus=(2.0, 0.0))
    width = {c: rms_width(coloured.kernel(CENTER, LensSettings(channel=c), size=31)) for c in ("r", "g", "b")}

    assert width["g"] < 0.8 * min(width["r"], width["b"])


def test_finer_pixels_show_the_same_kernel_larger() -> None:
    comatic = lens(f_number=2.0, coma=3.0)
    h = (0.9, 0.4)
    fine = comatic.kernel_at_field(h, LensSettings(), 63, pitch_um=2.0)
    binned = fine.reshape(21, 3, 21, 3).sum(axis=(1, 3))
    coarse = comatic.kernel_at_field(h, LensSettings(), 21, pitch_um=6.0, offset=centroid(binned))

    assert np.linalg.norm(binned - coarse) < 0.01 * np.linalg.norm(coarse)


def test_zoom_passes_through_its_ends_and_lies_between() -> None:
    zoom = draw_lens(1, "zoom")
    short, long = zoom.focal_mm
    position = FieldPosition(0.9, 0.4)
    ends = [rms_width(zoom.kernel(position, LensSettings(focal_mm=f), size=41)) for f in (short, long)]
    middle = zoom.at_focal(math.sqrt(short * long))

    assert zoom.at_focal(short) == zoom.optics[0]
    assert zoom.at_focal(long) == zoom.optics[1]
    assert middle.coma == pytest.approx((zoom.optics[0].coma + zoom.optics[1].coma) / 2)
    assert ends[0] != pytest.approx(ends[1], rel=0.02)


def test_lateral_colour_is_a_radial_polynomial_and_green_is_the_reference() -> None:
    fringed = lens(lateral_red=(1e-3, -4e-4))

    assert fringed.lateral_shift(0.5, "r") == pytest.approx(5e-4 - 4e-4 / 8)
    assert fringed.lateral_shift(0.9, "g") == 0.0


def test_equal_seeds_draw_equal_lenses_and_other_seeds_others() -> None:
    assert draw_lens(4, "coma") == draw_lens(4, "coma")
    assert draw_lens(4, "coma") != draw_lens(5, "coma")
    assert draw_lens(4, "coma").serial != draw_lens(5, "coma").serial


@pytest.mark.parametrize("kind", LENS_KINDS)
def test_drawn_lenses_have_realistic_widths(kind: str) -> None:
    for seed in (11, 12):
        drawn = draw_lens(seed, kind)
        center = rms_width(drawn.kernel(CENTER))
        corners = [rms_width(drawn.kernel(FieldPosition(0.95, phi))) for phi in (0.6, 2.5, -2.5, -0.6)]

        assert 0.2 < center < 1.6
        assert max(0.5, center) < np.mean(corners) < 5.0


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (lambda: draw_lens(0).kernel(CENTER, LensSettings(aperture=1.0)), "the lens works from"),
        (lambda: draw_lens(0).kernel(CENTER, LensSettings(focal_mm=500.0)), "covers"),
        (lambda: draw_lens(0).kernel(CENTER, size=30), "odd"),
        (lambda: draw_lens(0).kernel(CENTER, pitch_um=0.0), "pitch"),
        (lambda: draw_lens(0).kernel(CENTER, pitch_um=-4.5), "pitch"),
        (lambda: Aberrations(coma=math.nan), "finite"),
        (lambda: Aberrations(lateral_red=(0.0, math.inf)), "finite"),
        (lambda: Aberrations(f_number=-2.0), "f_number"),
        (lambda: SimulatedLens((Aberrations(), Aberrations()), (70.0, 24.0)), "ascending"),
        (lambda: SimulatedLens((Aberrations(),), (24.0, 70.0)), "one for each"),
        (lambda: SimulatedLens((), ()), "one for each"),
        (lambda: draw_lens(1, "magic"), "known"),
    ],
)
def test_impossible_requests_are_refused_with_the_reason(request_: Callable[[], object], said: str) -> None:
    with pytest.raises((InvalidInputError, UnknownMethodError), match=said):
        request_()
