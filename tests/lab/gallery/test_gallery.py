"""The gallery: each figure finds what it is meant to and is silent on clean pictures; the page builds."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, special

import lensmodel
from lab.gallery import page as shown_page
from lab.gallery.figures import dots, grain, grain_ratio, hue_flips, overshoots, percentile_of_edges
from lab.gallery.page import TILE, GalleryEntry, bars, entries_of, measured, places, text, write_page
from lab.gallery.pictures import FRAMES, Picture, chosen, real_pictures, rendered, take
from lab.images import gains
from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.lens import Lens
from lensmodel.photo import develop

Shown = NDArray[np.float64]
GREY = 0.45


def even(height: int = 64, width: int = 64, noise: float = 0.01, seed: int = 1) -> Shown:
    """An even ground with white noise."""
    rng = np.random.default_rng(seed)
    return np.clip(GREY + noise * rng.normal(size=(height, width, 3)), 0.0, 1.0)


@cache
def leaves(height: int, width: int) -> Shown:
    """Shapes of all sizes with sharp edges, coloured as moderately as most things are; not to be changed."""
    rng = np.random.default_rng(2)
    picture = np.full((height, width, 3), 0.5)
    rows, cols = np.mgrid[:height, :width]
    for _ in range(400):
        radius = float(rng.choice([2.0, 4.0, 8.0, 16.0]))
        row, col = rng.uniform(0, height), rng.uniform(0, width)
        inside = np.hypot(rows - row, cols - col) < radius
        picture[inside] = rng.uniform(0.2, 0.7) * rng.uniform(0.75, 1.25, 3)
    return ndimage.gaussian_filter(picture, (0.5, 0.5, 0.0))


def blurred(picture: Shown, sigma: float) -> Shown:
    return ndimage.gaussian_filter(picture, (sigma, sigma, 0.0), mode="nearest")


def grey(plane: Shown) -> Shown:
    return np.repeat(plane[..., None], 3, axis=-1)


ROWS, COLS = np.mgrid[:400, :96]
ACROSS = (COLS - 48.0) + 0.15 * (ROWS - 200.0)
"""Distance from a slanted edge."""


def stepped(ringing: float) -> tuple[Shown, Shown]:
    """A blurred slanted edge from .3 to .7, and it sharp with a halo of a given share of the step."""
    step = 0.5 * (1.0 + special.erf(ACROSS / (1.2 * 2**0.5)))
    sharp = 0.5 * (1.0 + np.tanh(ACROSS / 0.6))
    halo = np.exp(-0.5 * np.square((ACROSS - 3.0) / 1.2)) - np.exp(-0.5 * np.square((ACROSS + 3.0) / 1.2))
    return grey(0.3 + 0.4 * step), grey(0.3 + 0.4 * (sharp + ringing * halo))


@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_dots_are_found_where_they_were_put_and_pairs_of_them_too(value: float, channel: int) -> None:
    before = even()
    after = before.copy()
    put = [(5, 7), (20, 20), (20, 21), (30, 40), (50, 12)]
    for row, col in put:
        after[row, col, channel] = value

    assert [tuple(at) for at in np.argwhere(dots(before, after))] == put


def lamps() -> Shown:
    sharp = np.full((64, 64, 3), 0.1)
    sharp[20:22, 30:32] = (0.9, 0.2, 0.15)
    sharp[45, 12] = 0.9
    return sharp


def stripe(columns: slice, colour: float | tuple[float, float, float]) -> Shown:
    picture = even(noise=0.0)
    picture[:, columns] += colour
    return picture


GRAIN = even(200, 200, noise=0.01)
CLEAN = {
    "a line that got sharper": (
        even(noise=0.0) + np.convolve(np.eye(64)[32], [0.1, 0.25, 0.1], "same")[None, :, None],
        np.where(np.arange(64)[None, :, None] == 32, 1.0, even(noise=0.0)),
    ),
    "all that was blurred comes back": (blurred(leaves(200, 200), 1.0), leaves(200, 200)),
    "small coloured lamps come back": (blurred(lamps(), 0.8), lamps()),
    "grain that was doubled": (GRAIN, GREY + 2.0 * (GRAIN - GREY)),
    "a colour that moved": (stripe(np.s_[30:34], (0.2, 0.0, 0.0)), stripe(np.s_[32:36], (0.2, 0.0, 0.0))),
}


@pytest.mark.parametrize("case", CLEAN)
def test_what_is_no_fault_has_neither_dots_nor_flips(case: str) -> None:
    assert not dots(*CLEAN[case]).any()
    assert not hue_flips(*CLEAN[case]).any()


def test_a_dark_pixel_that_the_truth_has_is_no_dot_and_one_that_it_lacks_is() -> None:
    before = even(noise=0.0)
    after, truth = before.copy(), before.copy()
    truth[20, 20] = after[20, 21] = after[40, 40] = 0.1

    assert np.argwhere(dots(before, after, truth)).tolist() == [[40, 40]]


@pytest.mark.parametrize(
    ("sky", "ground", "dot"),
    [(1.0, (0.45, 0.42, 0.38), (0.0, 1.0, 1.0)), ((0.8, 0.15, 0.1), (0.8, 0.15, 0.1), (0.1, 0.8, 0.1))],
)
def test_pixels_of_another_hue_are_flips_unless_the_truth_has_them(sky: Any, ground: Any, dot: Any) -> None:
    before = np.full((64, 64, 3), sky)
    before[:, 32:] = ground
    after = before.copy()
    after[10:40:5, 31] = dot

    assert np.argwhere(hue_flips(before, after)).tolist() == [[row, 31] for row in range(10, 40, 5)]
    assert not hue_flips(before, after, after).any()


def test_overshoot_of_a_known_halo_is_measured() -> None:
    found = overshoots(*stepped(0.2))

    assert len(found) >= 15
    assert np.median(found[:, 1]) == pytest.approx(20.0, abs=1.5)
    assert percentile_of_edges(found[:14]) is None
    assert percentile_of_edges(np.tile([1.0, 3.0], (60, 1))) == (1.0, 3.0)
    assert np.median(found[:, 0]) < 0.5


def edge_of_pixels() -> Shown:
    """The edge of `stepped` as sharp as pixels allow."""
    fine = (np.arange(96 * 8) + 0.5) / 8 - 48.5 + 0.15 * ((np.arange(400 * 8) + 0.5)[:, None] / 8 - 200.5)
    share = (fine > 0.0).reshape(400, 8, 96, 8).mean(axis=(1, 3))
    return grey(0.3 + 0.4 * share)


@pytest.mark.parametrize(("after", "most"), [(stepped(0.0)[1], 1.0), (edge_of_pixels(), 0.1)])
def test_an_edge_that_only_got_sharper_does_not_overshoot(after: Shown, most: float) -> None:
    found = overshoots(stepped(0.0)[0], after)

    assert len(found) >= 15
    assert found[:, 1].max() < most


def test_a_line_beside_an_edge_is_no_halo_where_the_original_or_the_truth_shows_it() -> None:
    before, after = stepped(0.2)
    sharp = stepped(0.0)[1]

    assert len(overshoots(before, after, sharp)) == len(overshoots(before, after))
    assert len(overshoots(before, after, after)) == 0
    before[(ACROSS > 3.0) & (ACROSS < 5.5)] += 0.25
    assert len(overshoots(before, sharp)) < 5


def test_grain_ratio_is_the_square_of_a_factor_in_every_band_and_smoothing_shows_in_the_fine_one() -> None:
    before = even(256, 256)

    ratio = grain_ratio(grain(before, GREY + 0.8 * (before - GREY)))
    smoothed = grain_ratio(grain(before, blurred(before, 0.8)))

    assert ratio is not None
    assert smoothed is not None
    assert [ratio[band] for band in ("coarse", "middle", "fine")] == pytest.approx([0.64] * 3, abs=0.01)
    assert smoothed["fine"] < 0.1 < smoothed["middle"] < smoothed["coarse"]


def test_what_the_truth_has_is_texture_and_no_grain() -> None:
    before = even(256, 256)
    weaker = GREY + 0.5 * (before - GREY)

    assert grain_ratio(grain(before, before, np.full_like(before, GREY))) is not None
    assert grain_ratio(grain(before, before, weaker)) is not None
    assert grain_ratio(grain(before, before, before)) is None


def test_gains_against_the_truth_are_those_of_the_errors_and_a_ruined_block_is_found() -> None:
    truth = leaves(300, 420)
    noise = np.random.default_rng(4).normal(size=truth.shape)
    before, after = truth + 0.02 * noise, truth + 0.01 * noise
    found = gains(before, after, truth)
    after[140:260, 140:260] = before[140:260, 140:260] + 0.1
    ruined = gains(before, after, truth)

    assert found is not None
    assert ruined is not None
    assert list(found.zones.values()) == pytest.approx([6.02] * 3, abs=0.2)
    assert found.loss_share == 0.0
    assert ruined.worst_db < -10.0
    assert ruined.worst_at == pytest.approx((136, 136), abs=28)
    assert ruined.loss_share > 0.0


def stored(picture: Shown) -> NDArray[np.uint16]:
    return np.rint(np.clip(picture, 0.0, 1.0) * 65535).astype(np.uint16)


def test_faults_across_tiles_are_counted_once_and_their_place_is_told() -> None:
    before = stored(even(TILE + 100, 200))
    after = before.copy()
    for row in range(TILE - 4, TILE + 4, 2):
        after[row, 100] = (0, 65535, 0)

    found = measured(before, after, None)

    assert found["dots"] == found["hue_flips"] == 4
    assert abs(found["dots_at"][0] - TILE) <= 48
    # what was not measured has no bar
    assert bars(found) == {"dots": False, "hue flips": False, "grain": True}


def test_the_most_changed_places_are_those_that_were_changed() -> None:
    before = stored(even(600, 600))
    after = before.copy()
    after[300:340, 440:480] //= 2

    found = {name: (row, col) for name, row, col in places(before, after)}

    row, col = found["most changed 1"]
    assert (340 - 96 <= row <= 300, 480 - 96 <= col <= 440) == (True, True)
    assert {"center", "upper left", "lower right"} <= set(found)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Test data of one photo, one stand-in, and files that hold no picture."""
    monkeypatch.setattr(shown_page, "ZOOM", 1)  # to pack enlarged crops would take longer than all the rest
    (tmp_path / "real").mkdir()
    (tmp_path / "meta").mkdir()
    eight = np.rint(255.0 * np.clip(blurred(leaves(224, 256), 1.0), 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(eight).save(tmp_path / "real" / "leaves.png")
    Image.fromarray(eight[:40, :60]).save(tmp_path / "meta" / "stand-in.jpg")
    (tmp_path / "meta" / "notes.tsv").write_text("a\tb\n", encoding="utf-8")
    return tmp_path


@cache
def known_lens(*args: Any, **options: Any) -> Lens:
    r, phi = map(np.ravel, np.meshgrid((0.1, 0.5, 0.9), (-2.0, 0.5, 2.5)))
    return Lens.from_kernels(np.stack([gaussian(15, np.eye(2))] * r.size), r, phi, aperture=5.6)


def test_the_pictures_of_a_folder_are_those_that_show_something(folder: Path, tmp_path: Path) -> None:
    odd = Picture("raw/odd.gpr", tmp_path / "odd.gpr", unreadable="packed as VC-5 is not read")

    assert [picture.name for picture in real_pictures(folder)] == ["real/leaves.png"]
    assert "packed as VC-5 is not read" in shown_in(tmp_path / "gallery", [odd])[1]
    with pytest.raises(InvalidInputError, match=r"'rose'; there are real/leaves\.png"):
        chosen(real_pictures(folder), ["rose"])


def shown_in(page: Path, pictures: list[Picture]) -> tuple[list[GalleryEntry], str]:
    """What became of pictures, and the page that shows it."""
    entries = list(entries_of(pictures, page, workers=1, on_picture=lambda *_: None))
    return entries, write_page(entries, page).read_text(encoding="utf-8")


def test_the_page_shows_a_corrected_picture_and_its_figures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lensmodel, "calibrate", known_lens)

    entries, page = shown_in(tmp_path / "gallery", real_pictures(folder))

    assert entries[0].work["state"] == "corrected"
    assert entries[0].figures["changed"] > 0.01
    assert len(entries[0].crops) >= 6
    for file in entries[0].crops.values():
        assert (tmp_path / "gallery" / file).is_file()
        assert f'src="{file}"' in page
    assert "| real/leaves.png | corrected |" in text(entries)


def test_a_photo_whose_calibration_is_refused_is_shown_as_it_was_and_not_tried_again(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def refused(*args: Any, **options: Any) -> Lens:
        calls.append(args)
        raise NotEnoughEvidenceError("no photo could be used")

    monkeypatch.setattr(lensmodel, "calibrate", refused)

    for _ in range(2):
        entries, page = shown_in(tmp_path / "gallery", real_pictures(folder))

        assert entries[0].work["state"] == "left alone"
        assert "calibration was refused: no photo could be used" in page
        assert entries[0].figures["changed"] == 0.0
        assert all(entries[0].bars.values())
    assert len(calls) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["red-cars", "sky-gradient"])
def test_a_simulated_frame_shows_its_truth_blurred(name: str, tmp_path: Path) -> None:
    (frame,) = (each for each in FRAMES if each.name == name)
    photo, truth = take(frame, tmp_path, height=160, width=224)

    developed = develop(photo)
    shown = rendered(developed.planes, developed.encoding)
    sharp = np.load(truth)

    assert shown.shape == sharp.shape == (160, 224, 3)
    assert np.corrcoef(shown[..., 1].ravel(), sharp[..., 1].ravel())[0, 1] > 0.7
    assert photo.suffix == (".jpg" if frame.jpeg else ".dng")
