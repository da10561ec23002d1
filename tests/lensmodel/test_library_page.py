"""docs/library.md: its five lines run, also without any extra, and so does every code block."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

import lensmodel
from lensmodel.photo import develop
from lensmodel.photo.values import PhotoMetadata
from lensmodel.photo.writing import write_bayer_dng
from lensmodel.quality import mtf50_from_kernel
from lensmodel.simulate import demo_scene

PAGE = Path(__file__).parents[2] / "docs" / "library.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
FIVE_LINES = BLOCKS[0]
ROWS, COLS = 320, 448
WIDTH_PX = 1.2
SHOTS = {"a.dng": ("tea-gardens", 400), "b.dng": ("lake", 400), "c.dng": ("city", 500)}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Grey photos behind one Gaussian blur, as small as ones that a lens is learned from can be."""
    for seed, (file, (scene, left)) in enumerate(SHOTS.items()):
        whole = demo_scene(scene)[1, 100 : 100 + 2 * ROWS, left : left + 2 * COLS]
        sharp = whole.reshape(ROWS, 2, COLS, 2).mean(axis=(1, 3))  # than the photograph itself
        light = ndimage.gaussian_filter(sharp, WIDTH_PX)
        electrons = np.random.default_rng(seed).poisson(20000.0 * np.clip(light, 0.0, 1.0))
        mosaic = np.rint(np.clip(512.0 + 0.75 * electrons, 0.0, 16383.0)).astype(np.uint16)
        metadata = PhotoMetadata(aperture=1.4, pixel_pitch_um=9.0)
        write_bayer_dng(tmp_path / file, mosaic, black=512, white=16383, metadata=metadata)
    return tmp_path


def test_the_five_lines_run(photos: Path, monkeypatch: pytest.MonkeyPatch, estimated_here: None) -> None:
    monkeypatch.chdir(photos)
    names: dict[str, Any] = {}

    exec(FIVE_LINES, names)

    lens, kernel, corrected = names["lens"], names["kernel"], names["photo"].planes
    assert sorted(lens.photos.values()) == ["a.dng", "b.dng"]
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
    known = {name: dict(registry) for name, registry in _registries().items()}
    names: dict[str, Any] = {"__name__": "__main__"}
    try:
        for number, block in enumerate(BLOCKS):
            exec(compile(block, f"library.md, block {number}", "exec"), names)
    finally:
        for name, registry in _registries().items():
            for entry in set(registry) - set(known[name]):
                registry.pop(entry)

    assert len(BLOCKS) == PAGE.read_text(encoding="utf-8").count("```python") > 5
    assert names["kernel"].shape == (55, 55)
    assert names["photo"].planes.shape == (3, ROWS, COLS)
    assert {"c.tif", "my-24mm.lensprofile"} <= {path.name for path in photos.iterdir()}
    assert sorted(names["lens"].photos.values()) == ["a.dng", "b.dng"]


def _registries() -> dict[str, Any]:
    return {"estimators": lensmodel.estimators, "deconvolvers": lensmodel.deconvolvers}


# ---- where no extra of the package is installed

ABSENT = [
    *("alembic", "dbos", "fastapi", "httpx2", "jinja2", "obstore", "prometheus_client", "pydantic"),
    *("pydantic_settings", "sqlalchemy", "sse_starlette", "starlette", "structlog", "uvicorn"),
    *("astropy", "distributed", "matplotlib", "skimage", "sklearn"),
]
"""What the extras bring, as it is imported."""

PROLOGUE = f"""
import sys

sys.modules |= dict.fromkeys({ABSENT!r})  # None: as if it were not installed
import numpy as np
import lensmodel
from lab.kernels import gaussian
from lensmodel.photo.writing import write_bayer_dng
from lensmodel.photo.values import PhotoMetadata

rows, cols = np.ogrid[:160, :240]
mosaic = (4000 + 2000 * np.sin(rows / 7.0) * np.cos(cols / 9.0)).astype(np.uint16)
for name in "abc":
    write_bayer_dng(name + ".dng", mosaic, black=512, white=16383, metadata=PhotoMetadata(aperture=1.4))
lensmodel.estimators.create("default"), lensmodel.selectors.create("r-map")
calibrate = lensmodel.calibrate  # it is imported, but takes minutes, and refuses such small photos
spots = [gaussian(15, np.eye(2))] * 8
lens = lensmodel.Lens.from_kernels(spots, np.linspace(0.1, 0.9, 8), np.linspace(-3.0, 3.0, 8), aperture=1.4)
lensmodel.calibrate = lambda photos: lens
"""
EPILOGUE = """
assert (kernel.shape, kernel.dtype) == ((55, 55), np.float64) and abs(kernel.sum() - 1.0) < 1e-9
assert (photo.planes.shape, photo.planes.dtype) == ((3, 160, 240), np.float32)
assert lensmodel.Lens.load("my-24mm.lensprofile").samples
try:
    calibrate(["a.dng", "b.dng"], workers=1)
except lensmodel.LensModelError as error:
    print(error)
"""


def test_the_package_itself_begins_with_the_same_lines() -> None:
    assert lensmodel.__doc__ is not None
    assert textwrap.indent(FIVE_LINES, "    ") in lensmodel.__doc__


def test_the_five_lines_run_without_any_extra(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROLOGUE + FIVE_LINES + EPILOGUE],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        # to compile the loops once more would take a minute
        env={name: os.environ[name] for name in ("NUMBA_CACHE_DIR", "OMP_NUM_THREADS")}
        | {"PYTHONPATH": str(PAGE.parents[1])},
    )

    assert done.returncode == 0, done.stderr
    assert "a.dng" in done.stdout  # why the photos were refused
    assert (tmp_path / "c.tif").exists()
