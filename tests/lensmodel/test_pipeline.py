from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lensmodel
from lab.images import fidelity
from lensmodel import api, correction, photo
from lensmodel.blind import sampling
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import to_json
from lensmodel.core.psf import PsfSample, delta
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.patches import Patch, Selection
from lensmodel.photo import LinearPhoto
from lensmodel.photo.development import photo_from_array
from lensmodel.simulate import SimulatedCamera, SimulatedPhoto, demo_scene, draw_lens, photograph, write_photo

LENS = draw_lens(5, "soft-fast")  # blurred in the center too: there is something to gain everywhere
CAMERA = SimulatedCamera(height=320, width=480, pitch_um=9.0)
SETTINGS = LensSettings(aperture=LENS.at_focal().f_number)


def taken(name: str, folder: Path, seed: int) -> tuple[Path, SimulatedPhoto]:
    scene = demo_scene(name)[:, 200 : 200 + CAMERA.height + 32, 400 : 400 + CAMERA.width + 32]
    rng = np.random.default_rng(seed)
    # coarse nodes: seconds, not minutes
    shot = photograph(np.ascontiguousarray(scene), LENS, SETTINGS, CAMERA, rng, size=31, step=0.5)
    path = folder / f"{name}.dng"
    write_photo(path, shot)
    return path, shot


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, SimulatedPhoto]]:
    folder = tmp_path_factory.mktemp("photos")
    return {name: taken(name, folder, seed) for seed, name in enumerate(("city", "lake"))}


@pytest.fixture(scope="module")
def city(photos: dict[str, tuple[Path, SimulatedPhoto]]) -> LinearPhoto:
    return photo.develop(photos["city"][0])


def test_developed_photo_comes_back_from_disk_as_it_was(city: LinearPhoto, tmp_path: Path) -> None:
    sampling.save_developed(city, tmp_path)
    back = sampling.load_developed(tmp_path)

    assert np.array_equal(back.planes, city.planes)
    assert back.planes.flags.writeable is False
    assert (back.frame, back.noise, back.clip) == (city.frame, city.noise, city.clip)
    assert back.info == city.info
    assert to_json(back.encoding) == to_json(city.encoding)


def test_half_written_folder_is_no_developed_photo(tmp_path: Path) -> None:
    (tmp_path / "photo.json").write_text("{}", encoding="utf-8")

    with pytest.raises(InvalidInputError, match="develop it again"):
        sampling.load_developed(tmp_path)


def test_a_developed_photo_that_does_not_fit_the_disk_leaves_no_remains(
    city: LinearPhoto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lensmodel.blind.sampling.save_array", full_disk)
    with pytest.raises(OSError, match="No space left"):
        sampling.save_developed(city, tmp_path)

    assert [path.name for path in tmp_path.iterdir()] == ["photo.json"]


def test_lateral_colour_does_not_hang_on_the_level_of_white(city: LinearPhoto) -> None:
    brighter = replace(city, planes=4.0 * city.planes, clip=(4.0, 4.0, 4.0))

    assert api.lateral_of(city).red_points > 0
    assert api.lateral_of(brighter).red_points == api.lateral_of(city).red_points


def test_cells_hold_every_patch_once_largest_first() -> None:
    place = FieldPosition(0.1, 0.0)
    patches = tuple(Patch(i, i, 64, place, 1.0, cell) for i, cell in enumerate((2, 1, 2, 0, 2, 1)))

    groups = sampling.patches_by_cell(Selection(patches, ()))

    assert [len(group) for group in groups] == [3, 2, 1]
    assert sorted(p.row for group in groups for p in group) == list(range(6))


@pytest.mark.parametrize("method", ["fast", pytest.param("standard", marks=pytest.mark.slow)])
def test_calibrated_lens_makes_another_photo_sharper(
    method: str, photos: dict[str, tuple[Path, SimulatedPhoto]], tmp_path: Path
) -> None:
    events: list[sampling.CalibrationEvent] = []
    city = photos["city"][0]
    lens = lensmodel.calibrate(city, on_event=events.append)
    path, shot = photos["lake"]
    output = tmp_path / "corrected.tif"

    corrected = lensmodel.correct(path, lens, output, method=method)

    before, after = (
        fidelity(planes, shot.sharp, CAMERA.frame, srgb=False)
        for planes in (photo.develop(path).planes, corrected.planes)
    )
    assert after["corner"] > before["corner"] + 0.5
    assert after["center"] > before["center"]
    assert output.stat().st_size > CAMERA.height * CAMERA.width * 6
    stages = [event.stage for event in events]
    assert stages[0] == "developing"
    assert stages[-1] == "counted"
    assert lensmodel.calibrate([city] * 2, lens=lens, on_event=events.append) is lens
    assert [event.stage for event in events][len(stages) :] == ["skipped"] * 2


def test_a_patch_that_took_no_part_becomes_a_sample_all_the_same(city: LinearPhoto) -> None:
    planes = city.planes.copy()
    planes[:, :128, :128] = 0.4  # nothing is seen here
    group = [Patch(row, row, 128, city.frame.position(row, row), 1.0, 0) for row in (0, 192)]

    found = sampling.estimate_cell(
        replace(city, planes=planes),
        group,
        settings=SETTINGS,
        photo_id="a",
        estimator="michaeli-irani",
        size=11,
    )

    assert [sample.position for sample in found[:2]] == [patch.position for patch in group]


def test_settings_given_by_hand_fill_what_the_file_does_not_say() -> None:
    said = photo.PhotoMetadata(aperture=2.8, focal_mm=35.0)

    chosen = said.settings(LensSettings(aperture=4.0, focus_m=2.0))

    assert (chosen.aperture, chosen.focal_mm, chosen.focus_m) == (2.8, 35.0, 2.0)


def test_json_refuses_what_it_could_not_read_back() -> None:
    with pytest.raises(InvalidInputError, match="object"):
        to_json({"x": object()})


def test_paper_method_warps_the_channels_before_it_corrects(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}

    def record(planes: np.ndarray, *args: object, lateral: object, **rest: object) -> correction.Corrected:
        seen.update(planes=planes, lateral=lateral)
        return correction.Corrected(planes, {})

    monkeypatch.setattr(api.correction, "correct_planes", record)
    monkeypatch.setattr(api, "resample", lambda planes, *_: planes + 1)
    developed = photo_from_array(np.zeros((3, 4, 4)))
    model = LensModel.fit([PsfSample(delta(5), FieldPosition(0.1, 0.0))])

    for method, warped in (("paper", True), ("standard", False)):
        api.correct_photo(developed, model, LensSettings(), method=method, lateral="shift")  # type: ignore[arg-type]

        assert bool(np.asarray(seen["planes"]).any()) is warped
        assert seen["lateral"] == (None if warped else "shift")


def test_the_photo_that_is_corrected_joins_the_samples_once(
    photos: dict[str, tuple[Path, SimulatedPhoto]],
) -> None:
    paths = {name: path for name, (path, _) in photos.items()}
    model = lensmodel.calibrate(paths["city"]).model
    lake, city = (photo.develop(paths[name]) for name in ("lake", "city"))

    other = api.psfs_for(lake, model, SETTINGS, photo=sampling.photo_id(paths["lake"]))
    same = api.psfs_for(city, model, SETTINGS, photo=sampling.photo_id(paths["city"]))

    assert len(other.model.samples) > len(model.samples)
    assert {sample.photo for sample in other.model.samples} == {sampling.photo_id(p) for p in paths.values()}
    assert same.model is model
    assert 0.0 < other.answer_at(FieldPosition(0.5, 0.3), "g", 15).predicted_error <= 1.0
