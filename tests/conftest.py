from __future__ import annotations

import os
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
