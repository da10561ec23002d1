"""docs/library.md: every code block runs, from top to bottom, on simulated photos."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lensmodel
from lensmodel.core.types import LensSettings
from lensmodel.simulate import BlurOptions, SimulatedCamera, demo_scene, draw_lens, photograph, write_photo

PAGE = Path(__file__).parents[3] / "docs" / "library.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CAMERA = SimulatedCamera(height=384, width=576, pitch_um=9.0)
SHOTS = {"a.dng": ("tea-gardens", 400), "b.dng": ("lake", 400), "c.dng": ("city", 500)}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    lens = draw_lens(5, "soft-fast")
    settings = LensSettings(aperture=lens.at_focal().f_number)
    options = BlurOptions(pitch_um=CAMERA.pitch_um, step=0.3, size=41)
    for seed, (file, (scene, left)) in enumerate(SHOTS.items()):
        whole = demo_scene(scene)[:, 200 : 200 + CAMERA.height + 32, left : left + CAMERA.width + 32]
        rng = np.random.default_rng(seed)
        shot = photograph(np.ascontiguousarray(whole), lens, settings, CAMERA, rng, options=options)
        write_photo(tmp_path / file, shot)
    return tmp_path


@pytest.mark.slow
def test_every_block_of_the_page_runs(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(photos)
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    known = {name: dict(registry.entries) for name, registry in _registries().items()}
    names: dict[str, Any] = {"__name__": "__main__"}
    try:
        for number, block in enumerate(blocks):
            exec(compile(block, f"library.md, block {number}", "exec"), names)
    finally:
        for name, registry in _registries().items():
            for entry in set(registry.entries) - set(known[name]):
                registry.entries.pop(entry)  # type: ignore[attr-defined]

    assert len(blocks) == PAGE.read_text(encoding="utf-8").count("```python") > 5
    assert names["kernel"].shape == (55, 55)
    assert names["photo"].planes.shape == (3, CAMERA.height, CAMERA.width)
    assert {"c.tif", "my-24mm.lensprofile"} <= {path.name for path in photos.iterdir()}
    assert names["lens"].model.warm
    assert sorted(names["lens"].profile.photos.values()) == ["a.dng", "b.dng"]


def _registries() -> dict[str, Any]:
    return {"estimators": lensmodel.estimators, "deconvolvers": lensmodel.deconvolvers}
