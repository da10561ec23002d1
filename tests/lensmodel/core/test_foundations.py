"""Places, settings, kernels, names, least squares, files and processes."""

from __future__ import annotations

import io
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lab import kernels
from lensmodel.core import errors, psf
from lensmodel.core.files import atomic, replacing, save_array, write_atomically
from lensmodel.core.names import camera_name, full_name
from lensmodel.core.numerics import nonnegative_least_squares
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


# ---- files


@given(arrays.arrays(st.sampled_from([np.float32, np.float64, np.uint16]), arrays.array_shapes(min_side=0)))
def test_an_array_reads_back_as_numpy_wrote_it(array: np.ndarray) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    save_array(ours, array)
    np.save(theirs, array, allow_pickle=False)

    assert ours.getvalue() == theirs.getvalue()


def test_an_array_in_another_order_is_the_same_array(tmp_path: Path) -> None:
    array = np.asfortranarray(np.arange(24.0).reshape(2, 3, 4))
    with (tmp_path / "a.npy").open("wb") as file:
        save_array(file, array[:, ::-1])

    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), array[:, ::-1])


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_what_a_file_has_no_room_for_is_told_with_its_number(tmp_path: Path) -> None:
    program = """
import errno, resource, signal, sys
import numpy as np
from lensmodel.core.files import save_array
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with open(sys.argv[1], "wb") as file:
        save_array(file, np.ones((100, 100)))
except OSError as error:
    sys.exit(0 if error.errno == errno.EFBIG else repr(error))
sys.exit("nothing was raised")
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.npy")], capture_output=True, check=False
    )

    assert (done.returncode, done.stderr) == (0, b"")


def test_a_file_is_replaced_whole_or_left_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.tar.txt"
    write_atomically(path, b"first")
    with pytest.raises(TypeError), atomic(path) as file:
        file.write("no bytes")  # type: ignore[arg-type]

    assert path.read_bytes() == b"first"
    with replacing(path) as part:
        part.write_bytes(b"second")
        assert (part.parent, part.suffix) == (tmp_path, ".txt")
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


# ---- workers end with whoever started them, however that ends

SCRIPT = """
import os, time
from lensmodel.core.processes import pool

with pool(None, 2) as workers:
    pids = {workers.submit(os.getpid).result()}
    waiting = [workers.submit(time.sleep, 600) for _ in range(2)]
    while len(pids) < 2:
        pids = set(workers._processes)
    print(*sorted(pids), flush=True)
    time.sleep(600)
"""
PATIENCE_S = 60.0


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.skipif(sys.platform == "win32", reason="processes are asked after by a signal")
def test_workers_of_a_killed_script_end() -> None:
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True) as script:
        assert script.stdout is not None
        workers = [int(pid) for pid in script.stdout.readline().split()]
        assert len(workers) == 2
        assert all(alive(pid) for pid in workers)
        script.send_signal(signal.SIGKILL)
        script.wait()

    until = time.monotonic() + PATIENCE_S
    while any(alive(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in workers)
