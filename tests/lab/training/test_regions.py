from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from lab.training.train_regions import Labelled, fit
from lensmodel.core.errors import InvalidInputError
from lensmodel.patches.good_regions import FEATURES


def labelled(count: int, half: str, seed: int) -> list[Labelled]:
    """Windows whose similarity follows the first feature, in groups of eight."""
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(count):
        features = rng.normal(size=FEATURES)
        ncc = 1.0 - min(float(np.exp(-2.0 - features[0] + 0.1 * rng.normal())), 0.99)
        about = {"group": f"{half}/{i // 8}", "half": half, "r_map_score": float(rng.random()), "ncc": ncc}
        rows.append(Labelled(features=tuple(features.tolist()), **about))
    return rows


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.jsonl"
    rows = labelled(240, "dev", 0) + labelled(80, "test", 1)
    path.write_text("".join(json.dumps(asdict(row)) + "\n" for row in rows))
    return path


def test_training_finds_what_the_similarity_depends_on(table: Path, tmp_path: Path) -> None:
    report = fit(table, tmp_path / "model.npz")

    assert report["learned"] > 0.8
    assert abs(report["r-map"]) < 0.4  # the r-map scores of this table are random


def test_a_table_with_one_half_only_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.jsonl"
    path.write_text("".join(json.dumps(asdict(row)) + "\n" for row in labelled(16, "dev", 0)))

    with pytest.raises(InvalidInputError, match="both halves"):
        fit(path, tmp_path / "model.npz")
