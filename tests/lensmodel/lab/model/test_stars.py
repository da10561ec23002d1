"""Stars of a picture as measured PSFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import distance, gaussian
from lensmodel.lab.model.model_benchmark import load_field, run_model_benchmark, table
from lensmodel.lab.model.stars import stars_of

WIDTH = [[1.6, 0.4], [0.4, 1.0]]


@pytest.fixture
def sky(tmp_path: Path) -> Path:
    """48 stars of one shape on a noisy sky; a clipped one and a double one among them."""
    rng = np.random.default_rng(0)
    picture = rng.normal(1000.0, 5.0, (320, 420))
    star = np.array(gaussian(11, WIDTH))
    for i in range(6):
        for j in range(8):
            row, col = 30 + 50 * i, 30 + 50 * j
            picture[row - 5 : row + 6, col - 5 : col + 6] += rng.uniform(8e3, 3e4) * star / star.max()
    picture[80 - 5 : 80 + 6, 84 - 5 : 84 + 6] += 2e4 * star / star.max()
    picture[28:33, 28:33] = 6e4
    path = tmp_path / "sky.tif"
    tifffile.imwrite(path, np.clip(picture, 0, 65535).astype(np.uint16))
    return path


def test_stars_are_found_where_they_are_and_as_wide_as_they_are(sky: Path) -> None:
    samples = stars_of(sky)

    assert len(samples) == 46
    assert {s.photo for s in samples} == {f"group{i}" for i in range(5)}
    assert all(distance(s.kernel, gaussian(11, WIDTH)).rel_l2 < 0.05 for s in samples)


def test_hot_pixels_are_no_stars(sky: Path, tmp_path: Path) -> None:
    picture = np.array(tifffile.imread(sky))
    for i in range(5):
        picture[55 + 50 * i, 55 + 50 * i] += 4000 * (i + 1)
    hot = tmp_path / "hot.tif"
    tifffile.imwrite(hot, picture)

    found, before = stars_of(hot), stars_of(sky)

    assert len(found) == len(before) == 46
    assert max(s.kernel.max() for s in found) < 0.2


def test_star_field_is_predicted_by_the_other_stars(sky: Path) -> None:
    result = run_model_benchmark(psf_field=sky, methods=["nadaraya-watson", "eff-linear"])

    assert len(load_field(sky)) == result["samples"]
    assert all(max(row["errors"].values()) < 0.1 for row in result["rows"])


def test_errors_of_alike_stars_are_the_noise_of_the_held_out_ones(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    picture, star = rng.normal(1000.0, 400.0, (320, 420)), np.array(gaussian(11, np.eye(2)))
    for i in range(48):
        row, col = 30 + 50 * (i // 8), 30 + 50 * (i % 8)
        picture[row - 5 : row + 6, col - 5 : col + 6] += rng.uniform(8e3, 2e4) * star / star.max()
    tifffile.imwrite(tmp_path / "noisy.tif", picture.astype(np.float32))

    result = run_model_benchmark(psf_field=tmp_path / "noisy.tif", methods=["nadaraya-watson"])

    (row,) = result["rows"]
    assert all(row["net"][zone] < 0.6 * row["errors"][zone] for zone in row["errors"])
    assert "mid, net of noise" in table(result)


def test_picture_without_stars_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flat.tif"
    tifffile.imwrite(path, np.full((200, 200), 1000, dtype=np.uint16))

    with pytest.raises(InvalidInputError, match="usable stars"):
        load_field(path)
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises(InvalidInputError, match="no TIFF"):
        load_field(tmp_path / "text.tif")
