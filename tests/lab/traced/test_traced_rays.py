"""The tracer against closed forms, and the third-order simulator against the tracer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import j1

pytest.importorskip("optiland", reason="the tracer is the extra `lab`")

from lab.traced.copies import copies
from lab.traced.designs import designs
from lab.traced.image import kernel_of
from lab.traced.lens import Copy, TracedLens
from lab.traced.make import make_grid
from lab.traced.patents import PATENTS
from lab.traced.prescription import Design, Surface, optic_of
from lab.traced.rays import Fault, Tracer
from lab.traced.wave import TracedPupil
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import centroid, distance
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.simulate import Aberrations, SimulatedLens
from lensmodel.simulate.lens import spectrum

pytestmark = pytest.mark.filterwarnings("ignore")  # compiled parts of the tracer warn at first use

WAVE_UM = 0.54


def pupil_terms(design: Design, radius: float, angle: float) -> dict[str, float]:
    """Wavefront in micrometres at the edge of the stop: terms of third and fifth order by least squares."""
    bundle = Tracer(design).bundles((math.sin(angle), 0.0), radius, (WAVE_UM,), rays=400)[0]
    u, v = bundle.stop / radius
    rho2 = u * u + v * v
    names = ["piston", "u", "v", "defocus", "astigmatism", "coma", "spherical", "fifth_coma", "w060", "w242"]
    basis = [
        np.ones_like(u), u, v, rho2, u * u, u * rho2, rho2**2, u * rho2**2, rho2**3, u * u * rho2,
    ]  # fmt: skip
    solved = np.linalg.lstsq(np.stack(basis, axis=1), bundle.path_um, rcond=None)[0]
    return dict(zip(names, (float(c) for c in solved), strict=True))


def test_parabola_has_the_coma_of_the_closed_form_and_no_spherical() -> None:
    focal, radius, angle = 100.0, 8.0, 2e-3
    mirror = Surface(-2.0 * focal, -focal, "mirror", conic=-1.0, stop=True)
    terms = pupil_terms(Design("parabola", "", (mirror,), 6.25, 1.0), radius, angle)
    coma_um = 1000.0 * angle * radius**3 / (4.0 * focal**2)  # W131 = theta a^3 / (4 f^2)

    assert abs(terms["coma"]) == pytest.approx(coma_um, rel=0.02)
    assert abs(terms["spherical"]) < 1e-3 * coma_um


@pytest.mark.parametrize("bending", [-1.0, 0.0, 0.7, 1.0])
def test_thin_lens_has_the_spherical_aberration_of_the_closed_form(bending: float) -> None:
    focal, radius = 100.0, 4.0
    glass = (1.5168, 64.17)
    n = float(np.ravel(optic_of(_singlet(1.5, 1.0, glass)).surfaces[1].material_post.n(WAVE_UM))[0])
    power = 1.0 / focal
    total = power / (n - 1.0)
    lens = _singlet(0.5 * total * (bending + 1.0), 0.5 * total * (bending - 1.0), glass, thickness=1e-3)
    terms = pupil_terms(lens, radius, 0.0)
    # Welford, Aberrations of Optical Systems, sec. 12.2, object at infinity; W040 = S_I / 8
    shape = bending - 2.0 * (n * n - 1.0) / (n + 2.0)
    form = (n / (n - 1.0)) ** 2 + (n + 2.0) / (n * (n - 1.0) ** 2) * shape**2 - n / (n + 2.0)
    w040_um = 1000.0 * radius**4 * power**3 * form / 32.0

    assert -terms["spherical"] == pytest.approx(w040_um, rel=0.01)  # its edge focuses too near


def _singlet(
    front: float, back: float, glass: tuple[float, float], thickness: float = 1.0, focal: float = 100.0
) -> Design:
    first, second = (1.0 / c if c else math.inf for c in (front, back))
    return Design(
        "singlet", "", (Surface(first, thickness, glass, stop=True), Surface(second, focal)), 12.0, 1.0
    )


def test_small_aperture_makes_an_airy_pattern() -> None:
    f_number, pitch = 11.0, 1.0
    lens = TracedLens(Copy("heliar", 8.0, corner_light=1.0))
    middle = lens.pupils((0.0, 0.0), "g", f_number)[1][0]
    kernel, _ = kernel_of(
        [(middle, WAVE_UM, 1.0)],
        lens.stop_radius(f_number),
        lens.limits,
        size=41,
        pitch_um=pitch,
        focus_um=lens.focus_um,
    )
    fine = (np.arange(41 * 5) - 102) / 5.0 * pitch
    x = np.pi * np.hypot(fine[:, None], fine[None, :]) / (WAVE_UM * f_number)
    x[x == 0] = 1e-9
    airy = ((2.0 * j1(x) / x) ** 2).reshape(41, 5, 41, 5).sum(axis=(1, 3))

    assert distance(kernel, airy).rel_l2 < 0.02


def traced_and_simulated(
    design: Design, f_number: float, field_deg: float, angle: float, **changed: float
) -> tuple[Kernel, Kernel]:
    """Kernels of a design by rays and by its sums of third-order theory, half a wave out of focus."""
    tracer, defocus, pitch = Tracer(design), -0.5, 0.25 * f_number
    radius, theta = float(tracer.marginal(f_number)[0]), math.radians(field_deg)
    direction = math.sin(theta) * math.cos(angle), math.sin(theta) * math.sin(angle)
    pupil = TracedPupil.of(tracer.bundles(direction, radius, (WAVE_UM,))[0])
    # W020 = -dz / (8 N^2): the sensor stands before the focus where the edge of the wave is late
    focus_um = 1000.0 * paraxial_shift(design) - 8.0 * f_number**2 * WAVE_UM * defocus
    band = [(pupil, wave, weight) for wave, weight in spectrum("g")]  # of the simulator
    traced, _ = kernel_of(band, radius, (), size=41, pitch_um=pitch, focus_um=focus_um)
    waves = seidel_waves(design, f_number, field_deg) | changed
    lens = SimulatedLens((Aberrations(f_number=f_number, defocus=defocus, **waves),))
    return traced, lens.kernel(FieldPosition(1.0, angle), LensSettings(), 41, pitch_um=pitch)


@pytest.mark.parametrize("angle", [0.0, 0.9, -2.3])
def test_third_order_simulator_agrees_with_the_tracer_on_a_slow_singlet(angle: float) -> None:
    curvature = 0.5 / (100.0 * 0.519)
    singlet = _singlet(0.5 * curvature, -1.5 * curvature, (1.5168, 64.17), thickness=0.01)

    assert distance(*traced_and_simulated(singlet, 14.0, 3.0, angle)).rel_l2 < 0.015
    for term in ("spherical", "coma", "astigmatism", "field_curvature"):
        flipped = {term: -seidel_waves(singlet, 14.0, 3.0)[term]}
        assert distance(*traced_and_simulated(singlet, 14.0, 3.0, angle, **flipped)).rel_l2 > 0.2


def test_third_order_simulator_is_the_limit_of_a_real_design_at_small_apertures() -> None:
    design = designs.create("heliar").scaled(4.0)
    errors = [distance(*traced_and_simulated(design, n, 4.0, 0.9)).rel_l2 for n in (5.6, 8.0, 11.0, 16.0)]

    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 0.05
    assert errors[-1] < 0.015


def test_third_order_simulator_is_the_limit_of_a_real_design_at_small_fields() -> None:
    design = designs.create("heliar").scaled(4.0)
    errors = [
        distance(*traced_and_simulated(design, 16.0, deg, 0.9)).rel_l2 for deg in (20.0, 12.0, 8.0, 4.0)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 0.05
    assert errors[-1] < 0.015


def seidel_waves(design: Design, f_number: float, field_deg: float) -> dict[str, float]:
    """Hopkins coefficients in waves from the sums of third-order theory, paraxial image plane."""
    system = optic_of(design)
    system.set_aperture(aperture_type="imageFNO", value=f_number)
    system.fields.add(y=field_deg)
    s1, s2, s3, s4, _ = (float(s) / (1e-3 * WAVE_UM) for s in system.aberrations.seidels())
    return {
        "spherical": s1 / 8.0,
        "coma": s2 / 2.0,
        "astigmatism": s3 / 2.0,
        "field_curvature": (s3 + s4) / 4.0,
    }


def paraxial_shift(design: Design) -> float:
    """Distance of the paraxial focus behind the last surface's image distance, in its unit."""
    height, slope = optic_of(design).paraxial.marginal_ray()
    return -float(np.ravel(height[-1])[0]) / float(np.ravel(slope[-1])[0])


@pytest.mark.parametrize(
    ("design", "focal_mm"), [("tronnier", 50.3), ("retrofocus", 35.4), ("aspheric", 49.5), ("noct", 59.6)]
)
def test_patents_have_their_focal_lengths_and_form_an_image(design: str, focal_mm: float) -> None:
    system = optic_of(designs.create(design))

    assert float(np.ravel(system.paraxial.f2())[0]) == pytest.approx(focal_mm, rel=0.005)
    assert abs(paraxial_shift(designs.create(design))) < 0.15


def test_patents_name_their_sources() -> None:
    assert {design.name for design in PATENTS} <= set(designs)
    assert all(any(mark in design.source for mark in ("US ", "JP ", "WO ")) for design in PATENTS)


def test_wavefront_polynomial_leaves_no_error() -> None:
    lens = TracedLens(copies["heliar"])
    for h in ((0.0, 0.0), (0.6, -0.4), (-0.8, 0.6)):
        for pupil, wave, _ in lens.pupils(h, "b", lens.copy.f_number):
            assert pupil.residual_um < 0.01 * wave


def test_grid_holds_the_exact_kernels_at_its_nodes() -> None:
    lens = TracedLens(copies["heliar"])
    grid = make_grid(lens, step=1.0, size=15)
    for place in (FieldPosition(0.0, 0.0), FieldPosition(1.0, 0.0), FieldPosition(1.0, -math.pi / 2)):
        kernel = grid.kernel_at(place, "r", 15)
        assert distance(kernel, lens.kernel(place, "r", 15)).rel_l2 < 2e-3
    assert grid.facts["path_misfit_waves"] < 0.01


def test_field_vectors_turn_the_kernels_of_a_perfect_copy() -> None:
    lens = TracedLens(Copy("reverse-telephoto", 5.6))
    right = lens.kernel(FieldPosition(0.8, 0.0), "g", 31)
    up = lens.kernel(FieldPosition(0.8, math.pi / 2), "g", 31)

    assert distance(np.rot90(right), up).rel_l2 < 0.01
    assert distance(np.rot90(right, 2), right).rel_l2 > 0.1
    np.testing.assert_allclose(right, right[::-1], atol=1e-4)


def test_shifted_element_breaks_the_symmetry_along_its_shift() -> None:
    shifted = TracedLens(Copy("heliar", 4.0, faults=(Fault(1, (40.0, 0.0)),), corner_light=1.0))
    perfect = TracedLens(Copy("heliar", 4.0, corner_light=1.0))
    kernels = [lens.kernel(FieldPosition(0.0, 0.0), "g", 31) for lens in (shifted, perfect)]

    assert distance(*kernels).rel_l2 > 0.1
    np.testing.assert_allclose(kernels[0], kernels[0][::-1], atol=1e-4)
    assert np.hypot(*centroid(kernels[0])) < 1e-2


def test_designs_say_how_far_they_open() -> None:
    with pytest.raises(InvalidInputError, match="does not open"):
        Tracer(designs.create("tronnier")).marginal(0.6)
    with pytest.raises(InvalidInputError, match="elements"):
        Tracer(designs.create("tronnier"), (Fault(9),))


def test_light_of_the_corner_passes_a_cover_glass_before_the_sensor() -> None:
    lens = TracedLens(copies["noct"])
    last = lens.design.surfaces[lens.rims[-1]]

    assert math.isfinite(last.radius)
    assert lens.rims[-1] < len(lens.design.surfaces) - 1
    pupils = lens.pupils((1.0, 0.0), "g", 1.2)
    assert len(pupils) == lens.copy.wavelengths
    assert sum(weight for _, _, weight in pupils) == pytest.approx(1.0)
