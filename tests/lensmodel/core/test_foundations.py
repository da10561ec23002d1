from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab import kernels
from lensmodel.core import errors, psf
from lensmodel.core.names import camera_name, full_name
from lensmodel.core.numerics import nonnegative_least_squares
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, Frame, LensSettings, zone_of

angles = st.floats(-10, 10)


def test_phi_points_towards_row_zero_at_plus_half_pi() -> None:
    frame = Frame(101, 201)

    assert frame.position(0, 100).phi == pytest.approx(math.pi / 2)
    assert frame.position(50, 200).phi == pytest.approx(0.0)
    assert frame.position(50, 100).r == 0.0


def test_r_is_one_at_the_outer_corner() -> None:
    assert Frame(100, 150).position(-0.5, -0.5).r == pytest.approx(1.0)


@given(st.floats(0, 1), angles)
def test_pixel_and_position_are_inverse(r: float, phi: float) -> None:
    frame = Frame(300, 400)
    back = frame.position(*frame.pixel(FieldPosition(r, phi)))

    assert back.r == pytest.approx(r, abs=1e-9)
    if r > 1e-6:
        assert math.cos(back.phi - phi) == pytest.approx(1.0)


@given(angles)
def test_phi_is_wrapped_without_changing_direction(phi: float) -> None:
    wrapped = FieldPosition(0.5, phi).phi

    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - phi) == pytest.approx(1.0)


@pytest.mark.parametrize(("r", "zone"), [(0.0, "center"), (0.3, "mid"), (0.75, "mid"), (0.76, "corner")])
def test_zone_limits(r: float, zone: str) -> None:
    assert zone_of(r) == zone


@pytest.mark.parametrize("r", [-0.1, 1.1, math.nan, math.inf])
def test_r_outside_the_field_is_refused_by_value(r: float) -> None:
    with pytest.raises(errors.InvalidInputError, match=str(r)):
        FieldPosition(r, 0.0)


@pytest.mark.parametrize("aperture", [0.0, 0.4, 129, math.nan, -2])
def test_impossible_apertures_are_refused(aperture: float) -> None:
    with pytest.raises(errors.InvalidInputError, match="f-number"):
        LensSettings(aperture=aperture)


def test_one_stop_is_a_factor_of_root_two() -> None:
    wide, stopped = LensSettings(aperture=1.4).stops, LensSettings(aperture=1.4 * math.sqrt(2)).stops

    assert wide is not None
    assert stopped is not None
    assert stopped - wide == pytest.approx(1.0)


def test_registry_names_what_it_knows() -> None:
    registry: Registry[int] = Registry("number", {"one": lambda: 1})

    with pytest.raises(errors.UnknownMethodError, match="known: one"):
        registry.create("three")


def lopsided(size: int = 21) -> np.ndarray:
    rng = np.random.default_rng(3)
    kernel = np.zeros((size, size))
    kernel[7:13, 8:15] = rng.random((6, 7))
    return kernel


def test_centred_puts_the_centre_of_mass_on_the_middle_pixel() -> None:
    kernel = psf.centred(lopsided())

    assert max(map(abs, psf.centroid(kernel))) < 5e-3
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel.min() >= 0


def test_gaussian_has_its_covariance_plus_the_pixel() -> None:
    covariance = np.array([[2.0, 0.7], [0.7, 1.2]])
    moments = psf.second_moments(kernels.gaussian(25, covariance), level=0.0)

    assert np.allclose(moments, covariance + np.eye(2) / 12, atol=0.02)


@settings(max_examples=20, deadline=None)
@given(st.floats(-2, 2), st.floats(-2, 2))
def test_distance_ignores_a_shift(row: float, col: float) -> None:
    reference = kernels.gaussian(31, np.diag([2.0, 1.5]))
    freq = np.fft.fftfreq(31)
    phase = np.exp(-2j * np.pi * (freq[:, None] * row + freq[None, :] * col))
    moved = np.fft.ifft2(np.fft.fft2(reference) * phase).real

    result = kernels.distance(moved, reference)

    assert result.rel_l2 < 5e-3
    assert result.ncc > 0.9999
    assert result.shift == (pytest.approx(-row, abs=0.01), pytest.approx(-col, abs=0.01))


def test_ncc_of_two_gaussians_is_the_closed_form() -> None:
    s1, s2 = 1.5, 2.5
    a, b = (kernels.gaussian(41, np.eye(2) * (s * s - 1 / 12)) for s in (s1, s2))

    assert kernels.distance(a, b).ncc == pytest.approx(2 * s1 * s2 / (s1**2 + s2**2), abs=2e-3)


@pytest.mark.parametrize(
    "bad", [np.ones((4, 4)), np.ones((3, 5)), -np.ones((3, 3)), np.full((3, 3), np.nan), np.zeros((3, 3))]
)
def test_arrays_that_are_no_psf_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(errors.InvalidInputError):
        psf.as_kernel(bad)


def test_sample_keeps_its_own_read_only_kernel() -> None:
    mine = lopsided()
    sample = psf.PsfSample(mine, FieldPosition(0.1, 0.2))
    mine[:] = 0

    assert sample.kernel.sum() == pytest.approx(1.0)
    with pytest.raises(ValueError, match="read-only"):
        sample.kernel[0, 0] = 1.0


# ---- names of cameras and lenses


@pytest.mark.parametrize(
    ("maker", "model", "name"),
    [
        ("Acme", "Acme 42mm", "Acme 42mm"),
        ("ACME", "Acme 42mm", "Acme 42mm"),
        ("Canon", "EF24mm f/1.4L", "Canon EF24mm f/1.4L"),
        (None, "42mm", "42mm"),
        ("Acme", None, "Acme"),
        (None, None, ""),
    ],
)
def test_a_maker_is_named_once(maker: str | None, model: str | None, name: str) -> None:
    assert full_name(maker, model) == name


@pytest.mark.parametrize(
    ("maker", "model", "name"),
    [
        ("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA", "Kodak Z612"),
        ("Eastman Kodak Company", "Kodak Digital Science DC50 Zoom Camera", "Kodak Digital Science DC50"),
        ("NIKON CORPORATION", "NIKON D1", "Nikon D1"),
        ("OLYMPUS IMAGING CORP.", "E-P3", "Olympus E-P3"),
        ("Hewlett-Packard", "HP Photosmart", "Hewlett-Packard HP Photosmart"),
        ("DJI", "FC300S", "DJI FC300S"),
        (None, "CAMERA", "CAMERA"),
    ],
)
def test_a_camera_is_named_without_company_and_kind(maker: str | None, model: str, name: str) -> None:
    assert camera_name(maker, model) == name


# ---- least squares


def test_least_squares_respects_the_sign_constraint() -> None:
    a = np.diag([2.0, 4.0, 1.0])

    k = nonnegative_least_squares(a, np.array([2.0, -3.0, 0.5]), np.ones(3))

    assert np.allclose(k, [1.0, 0.0, 0.5], atol=1e-6)


def test_where_nothing_is_known_the_start_comes_back() -> None:
    assert nonnegative_least_squares(np.zeros((2, 2)), np.zeros(2), np.ones(2)).tolist() == [1.0, 1.0]
