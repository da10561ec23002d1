"""Stars of a picture as measured PSFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from lensmodel.bench.model import load_field, run_model_benchmark
from lensmodel.bench.stars import stars_of
from lensmodel.errors import InvalidInputError
from lensmodel.psf import distance, gaussian

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


def test_star_field_is_predicted_by_the_other_stars(sky: Path) -> None:
    result = run_model_benchmark(psf_field=sky, methods=["nadaraya-watson", "eff-linear"])

    assert len(load_field(sky)) == result["samples"]
    assert all(max(row["errors"].values()) < 0.1 for row in result["rows"])


def test_picture_without_stars_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flat.tif"
    tifffile.imwrite(path, np.full((200, 200), 1000, dtype=np.uint16))

    with pytest.raises(InvalidInputError, match="usable stars"):
        load_field(path)
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises(InvalidInputError, match="no TIFF"):
        load_field(tmp_path / "text.tif")
