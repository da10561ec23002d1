"""What `import lensmodel` offers, and that it costs little."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lensmodel
from lab.kernels import gaussian
from lensmodel.api import say
from lensmodel.core import processes
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, centroid
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, LensSettings, field_grid
from lensmodel.lens import Lens
from lensmodel.model import LensModel

HEAVY = {"numpy", "scipy", "rawpy", "fastapi", "sqlalchemy", "pydantic", "app", "lab"}
SERVICE = {"fastapi", "sqlalchemy", "pydantic", "dbos", "structlog", "app", "lab"}


@pytest.mark.parametrize("name", lensmodel.__all__)
def test_a_public_name_exists_and_is_documented(name: str) -> None:
    assert inspect.getdoc(getattr(lensmodel, name))


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        lensmodel.nonsense  # noqa: B018 - the access is the test


@pytest.mark.parametrize(
    ("code", "unwanted"), [("import lensmodel", HEAVY), ("import lensmodel; lensmodel.calibrate", SERVICE)]
)
def test_importing_the_library_brings_no_more_than_it_needs(code: str, unwanted: set[str]) -> None:
    script = f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert not unwanted & set(json.loads(done.stdout))


# --- a field from arrays ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def lens() -> Lens:
    rng = np.random.default_rng(0)
    r, phi = np.sqrt(rng.random(24)), rng.uniform(-np.pi, np.pi, 24)
    kernels = np.stack([gaussian(15, np.eye(2) * (0.8 + 2.0 * radius)) for radius in r])
    return Lens.from_kernels(kernels, r, phi, aperture=2.0)


def test_a_lens_of_kernels_is_softer_where_they_were(lens: Lens) -> None:
    center, corner = lens.mtf([0.0, 0.9], [0.0, 0.5], [0.0, 0.2], aperture=2.0)[0]

    assert (center[0], corner[0]) == pytest.approx((1.0, 1.0))
    assert center[1] > corner[1] + 0.1
    assert center[1] == pytest.approx(np.exp(-2 * np.pi**2 * 0.2**2 * 0.8), abs=0.1)


def test_many_kernels_at_once_are_those_of_single_questions(lens: Lens) -> None:
    many = lens.kernels([[0.1], [0.8]], [0.3, 2.0, -1.0], aperture=2.0, size=15)

    assert many.shape == (2, 3, 15, 15)
    assert many[1, 2] == pytest.approx(lens.psf(0.8, -1.0, aperture=2.0, size=15).kernel)


def test_every_question_to_a_zoom_can_name_its_focal_length_and_focus() -> None:
    settings = [LensSettings(2.8, focal, focus) for focal in (24.0, 70.0) for focus in (0.5, 20.0)]
    samples = [
        PsfSample(
            gaussian(15, np.eye(2) * (0.6 if at.focal_mm == 24.0 else 2.5)),
            FieldPosition(r, phi),
            at,
            photo="x",
        )
        for at in settings
        for r in (0.1, 0.5, 0.9)
        for phi in (-2.0, 0.5, 2.5)
    ]
    lens = Lens(LensModel.fit(samples))
    wide, long = ({"aperture": 2.8, "focal_mm": focal, "focus_m": 0.5} for focal in (24.0, 70.0))

    assert lens.kernels(0.5, 0.5, size=15, **wide) == pytest.approx(
        lens.psf(0.5, 0.5, size=15, **wide).kernel
    )
    assert lens.mtf(0.5, 0.5, 0.2, **wide).min() > lens.mtf(0.5, 0.5, 0.2, **long).max() + 0.1
    assert lens.mtf50_map(1, 2, **wide).min() > lens.mtf50_map(1, 2, **long).max()


def test_a_kernel_that_is_given_off_center_is_centered() -> None:
    kernel = np.zeros((1, 9, 9))
    kernel[0, 4, 6] = 3.0

    sample = Lens.from_kernels(kernel, [0.5], [0.0]).samples[0]

    assert centroid(sample.kernel) == pytest.approx((0.0, 0.0), abs=1e-2)
    assert sample.kernel.sum() == pytest.approx(1.0)


def test_the_map_is_that_of_the_kernels_and_row_0_is_the_top(lens: Lens) -> None:
    r, phi = field_grid(2, 3, aspect=1.5)
    assert phi[0, 1] == pytest.approx(np.pi / 2)
    assert (r[0, 0], np.cos(phi[0, 2]) > 0, np.sin(phi[1, 0]) < 0) == (pytest.approx(r[1, 2]), True, True)
    assert lens.mtf50_map(2, 3, aperture=2.0).shape == (2, 2, 3)


@pytest.mark.parametrize(
    "change",
    [{"r": [0.1, 0.2]}, {"kernels": np.ones((5, 5))}, {"channel": ["g", "r"]}, {"aperture": [1.0, 2.0]}],
    ids=str,
)
def test_arrays_that_do_not_fit_each_other_are_refused(change: dict[str, Any]) -> None:
    given: dict[str, Any] = {"kernels": np.ones((1, 5, 5)), "r": [0.1], "phi": [0.0], **change}

    with pytest.raises(InvalidInputError):
        Lens.from_kernels(**given)


@pytest.mark.parametrize("frequencies", [[[0.1, 0.2]], [0.1, np.nan], [0.1, -0.2]], ids=str)
def test_frequencies_that_no_contrast_has_are_refused(frequencies: Any, lens: Lens) -> None:
    with pytest.raises(InvalidInputError, match="flat list"):
        lens.mtf(0.5, 0.0, frequencies)


def test_places_whose_shapes_do_not_fit_are_refused(lens: Lens) -> None:
    with pytest.raises(InvalidInputError, match=r"\(2,\) and \(3,\)"):
        lens.kernels([0.1, 0.2], [0.0, 1.0, 2.0])


# --- arrays in, arrays out; methods of one's own ----------------------------------------------


class Doubled:
    """A deconvolver that nobody else has."""

    def deconvolve(self, blurred: Any, blur: Any, *, sensor: Any) -> Any:
        return blurred


def test_an_array_is_corrected_by_a_name_and_by_an_object(tmp_path: Path, lens: Lens) -> None:
    planes = np.random.default_rng(1).random((3, 96, 128), dtype=np.float32)
    output = tmp_path / "out.tif"

    named = lensmodel.correct(planes, lens, aperture=2.0, method="fast", workers=1)
    own = lensmodel.correct(planes, lens, output, aperture=2.0, method=Doubled(), workers=1)

    assert named.planes.shape == own.planes.shape == planes.shape
    assert named.planes.dtype == np.float32
    assert output.stat().st_size > planes.size * 2


def test_what_would_be_lost_work_is_refused_before_it(lens: Lens) -> None:
    planes = np.zeros((3, 8, 8), dtype=np.float32)

    with pytest.raises(InvalidInputError, match=r"no format for out\.xyz"):
        lensmodel.correct(planes, lens, "out.xyz")
    with pytest.raises(InvalidInputError, match="standard"):
        lensmodel.correct(planes, lens, method="nonsense")
    with pytest.raises(InvalidInputError, match="height, width"):
        lensmodel.correct(planes[0], lens)
    with pytest.raises(InvalidInputError, match="workers must be at least 1, got 0"):
        lensmodel.correct(planes, lens, workers=0)
    with pytest.raises(FileNotFoundError):
        lensmodel.calibrate("gone.dng")


@pytest.mark.parametrize("value", [-1.0, 0.0, float("nan")])
def test_an_aperture_that_no_lens_has_is_refused_before_a_photo_is_read(value: float, lens: Lens) -> None:
    for refused in (
        lambda: lensmodel.photo_from_array(np.zeros((3, 8, 8)), aperture=value),
        lambda: lensmodel.correct("gone.dng", lens, aperture=value),
        lambda: lensmodel.calibrate([], aperture=value),
    ):
        with pytest.raises(InvalidInputError, match=f"f-number in 0.5..128, got {value}"):
            refused()


@pytest.mark.parametrize("value", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_pixel_pitch_that_no_sensor_has_is_refused(value: float) -> None:
    with pytest.raises(InvalidInputError, match=f"positive micrometres, got {value}"):
        lensmodel.photo_from_array(np.zeros((3, 8, 8)), pixel_pitch_um=value)


@pytest.mark.parametrize("asked", [{"workers": 0}, {"patches": 0}, {"kernel_size": 0}], ids=str)
def test_a_calibration_that_asks_for_nothing_is_refused_at_once(asked: dict[str, int]) -> None:
    with pytest.raises(InvalidInputError, match=", got 0"):
        lensmodel.calibrate([], **asked)  # type: ignore[arg-type]


def test_a_photo_is_not_replaced_by_its_correction(tmp_path: Path, lens: Lens) -> None:
    path = tmp_path / "one.tif"
    path.write_bytes(b"II*\0")

    with pytest.raises(InvalidInputError, match="the photo itself"):
        lensmodel.correct(path, lens, path)


def test_a_registered_method_is_known_by_its_name() -> None:
    registry: Registry[Doubled] = Registry("deconvolver", {"first": Doubled})
    registry.register("doubled", Doubled)

    assert isinstance(registry.resolve("doubled"), Doubled)
    assert set(registry) == {"doubled", "first"}
    with pytest.raises(InvalidInputError, match="exists already"):
        registry.register("first", Doubled)


# --- worker processes -------------------------------------------------------------------------


def test_what_other_processes_cannot_load_runs_in_threads_of_this_one() -> None:
    own = type("Own", (), {"__module__": "__main__"})()

    assert processes.portable(Doubled())
    assert not processes.portable(own)
    assert not processes.portable(lambda: None)
    with processes.pool(None, 1, own) as pool:
        assert pool.submit(id, own).result() == id(own)


@pytest.mark.parametrize(("r", "aperture"), [(0.95, 2.8), (0.05, 16.0), (0.9, 22.0)])
def test_a_question_outside_what_the_photos_show_warns(r: float, aperture: float) -> None:
    lens = lensmodel.Lens.from_kernels(
        [np.outer(*[np.hanning(7)] * 2)] * 3, [0.0, 0.1, 0.1], [0.0, 1.0, 2.0], aperture=2.8
    )

    with pytest.warns(UserWarning, match="is a guess"):
        lens.psf(r, 0.6, aperture=aperture)


def test_a_lens_is_shown_in_words(lens: Lens) -> None:
    assert "0x" not in repr(lens)
    assert f"{len(lens.samples)} samples" in repr(lens)


@pytest.mark.parametrize(
    ("terminal", "notebook", "said"),
    [
        (True, False, "\r\x1b[Ka.dng: 50%\r\x1b[Ka.dng: done\n"),
        (False, True, "a.dng: done\n"),
        (False, False, ""),
    ],
)
def test_a_terminal_shows_each_step_and_a_notebook_whole_lines(
    terminal: bool,
    notebook: bool,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    if notebook:
        monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))

    say("a.dng: 50%")
    say("a.dng: done", stays=True)

    assert capsys.readouterr().err == said
