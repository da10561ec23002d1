"""docs/library.md: its five lines run, and every code block does, from top to bottom, on simulated photos."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

import lensmodel
from lensmodel.core.types import LensSettings
from lensmodel.photo import develop
from lensmodel.photo.values import PhotoMetadata
from lensmodel.photo.writing import write_bayer_dng
from lensmodel.quality import mtf50_from_kernel
from lensmodel.simulate import BlurOptions, SimulatedCamera, demo_scene, draw_lens, photograph, write_photo

PAGE = Path(__file__).parents[2] / "docs" / "library.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CAMERA = SimulatedCamera(height=384, width=576, pitch_um=9.0)
WIDTH_PX = 1.2
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


@pytest.fixture
def smallest_photos(tmp_path: Path) -> Path:
    """Grey photos behind one Gaussian blur, as small as ones that a lens is learned from can be."""
    rows, cols = 320, 448
    for seed, (file, (scene, left)) in enumerate(SHOTS.items()):
        whole = demo_scene(scene)[1, 100 : 100 + 2 * rows, left : left + 2 * cols]
        sharp = whole.reshape(rows, 2, cols, 2).mean(axis=(1, 3))  # than the photograph itself
        light = ndimage.gaussian_filter(sharp, WIDTH_PX)
        electrons = np.random.default_rng(seed).poisson(20000.0 * np.clip(light, 0.0, 1.0))
        mosaic = np.rint(np.clip(512.0 + 0.75 * electrons, 0.0, 16383.0)).astype(np.uint16)
        metadata = PhotoMetadata(aperture=1.4, pixel_pitch_um=9.0)
        write_bayer_dng(tmp_path / file, mosaic, black=512, white=16383, metadata=metadata)
    return tmp_path


def test_the_five_lines_run(
    smallest_photos: Path, monkeypatch: pytest.MonkeyPatch, estimated_here: None
) -> None:
    monkeypatch.chdir(smallest_photos)
    names: dict[str, Any] = {}

    exec(BLOCK.findall(PAGE.read_text(encoding="utf-8"))[0], names)

    lens, kernel, corrected = names["lens"], names["kernel"], names["photo"].planes
    assert sorted(lens.profile.photos.values()) == ["a.dng", "b.dng"]
    assert (kernel.shape, kernel.sum()) == ((55, 55), pytest.approx(1.0))
    # of a Gaussian: exp(-2 (pi s f)^2) = 1/2
    half = math.sqrt(math.log(2.0) / 2.0) / (math.pi * WIDTH_PX)
    assert mtf50_from_kernel(kernel, 0.0) == pytest.approx(half, rel=0.35)
    before = develop("c.dng").planes
    assert np.abs(np.diff(corrected[1])).mean() > 1.05 * np.abs(np.diff(before[1])).mean()
    assert Path("c.tif").stat().st_size > 6 * corrected[0].size
    assert len(lensmodel.Lens.load("my-24mm.lensprofile").samples) == len(lens.samples)


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
    assert sorted(names["lens"].profile.photos.values()) == ["a.dng", "b.dng"]


def _registries() -> dict[str, Any]:
    return {"estimators": lensmodel.estimators, "deconvolvers": lensmodel.deconvolvers}
