from __future__ import annotations

import os

# Before NumPy is imported: tests run in parallel processes, threads inside each only slow them down.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the external photos; a test that needs them is marked `tools`."""
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    if not folder:
        pytest.skip("LENSMODEL_TEST_DATA does not name the folder of the external photos")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"LENSMODEL_TEST_DATA names {folder}, which is no folder")
    return path
