"""The five lines of the documentation run where no extra of the package is installed."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import lensmodel

LIBRARY = Path(__file__).parents[2] / "docs" / "library.md"
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


@pytest.fixture(scope="module")
def five_lines() -> str:
    found = re.search(r"```python\n(.*?)```", LIBRARY.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found.group(1)


def test_the_package_itself_begins_with_the_same_lines(five_lines: str) -> None:
    assert lensmodel.__doc__ is not None
    assert textwrap.indent(five_lines, "    ") in lensmodel.__doc__


def test_the_five_lines_run_without_any_extra(five_lines: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROLOGUE + five_lines + EPILOGUE],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(LIBRARY.parents[1]), "OMP_NUM_THREADS": "1"},
    )

    assert done.returncode == 0, done.stderr
    assert "a.dng" in done.stdout  # why the photos were refused
    assert (tmp_path / "c.tif").exists()
