"""Methods of one's own, brought by an installed package: library, command and service know their names."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from running import PROGRAM, running, write_photo

import lensmodel
from lensmodel.core import registry
from lensmodel.core.errors import UnknownMethodError
from lensmodel.core.registry import Registry

HERE = Path(__file__).parent
MODULE = '''
from dataclasses import dataclass

import lensmodel


@dataclass(frozen=True)
class Careful:
    """The estimator "default", trusted half as much."""

    name: str = "careful"
    version: int = 1

    def estimate(self, patches, noise, **options):
        found = lensmodel.estimators.create("default").estimate(patches, noise, **options)
        return type(found)(found.kernel, found.confidence / 2, found.predicted_error)


class Everywhere:
    """Takes every window for as good as any other."""

    def score(self, windows, looked):
        return looked.information.mean(axis=(1, 2)) * 0.0 + 0.5


@dataclass(frozen=True)
class Adjoint:
    """Blurs once more: of no use, and easily told from a method that deblurs."""

    def deconvolve(self, blurred, blur, *, sensor):
        return blur.frame(blur.adjoint(blurred))
'''

POINTS = """[lensmodel.estimators]
careful = own_methods:Careful
broken = own_methods:Missing
[lensmodel.selectors]
everywhere = own_methods:Everywhere
[lensmodel.deconvolvers]
adjoint = own_methods:Adjoint
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package as an installer leaves it."""
    folder = tmp_path / "site"
    about = folder / "own_methods-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "own_methods.py").write_text(MODULE, encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own-methods\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(POINTS)
    return folder


@pytest.fixture
def installed(package: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(package))
    registry._entry_points.cache_clear()
    yield
    registry._entry_points.cache_clear()
    sys.modules.pop("own_methods", None)


@pytest.mark.usefixtures("installed")
def test_methods_of_a_package_are_known_by_their_names_and_correct() -> None:
    assert "careful" in lensmodel.estimators
    assert "everywhere" in list(lensmodel.selectors)
    assert lensmodel.estimators.create("careful").name == "careful"
    spots = np.ones((4, 5, 5))
    lens = lensmodel.Lens.from_kernels(spots, [0.1, 0.5, 0.9, 0.5], [0.0, 1.0, 2.0, -2.0], aperture=2.0)
    planes = np.random.default_rng(1).random((3, 64, 64), dtype=np.float32)

    corrected = lensmodel.correct(planes, lens, aperture=2.0, method="adjoint", workers=1)

    assert corrected.planes.shape == planes.shape


@pytest.mark.usefixtures("installed")
def test_a_package_that_cannot_be_loaded_is_named_and_none_replaces_a_method() -> None:
    lensmodel.estimators.load_installed()  # says so in the log, and goes on
    with pytest.raises(UnknownMethodError, match=r"broken.*own-methods cannot be loaded"):
        lensmodel.estimators.create("broken")
    taken: Registry[object] = Registry("estimator", {"careful": dict}, "lensmodel.estimators")

    assert taken.create("careful") == {}
    assert list(taken) == ["broken", "careful"]


@pytest.mark.slow
def test_command_and_service_work_by_methods_of_a_package(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = write_photo(tmp_path / "a.dng", 1)
    paths = [str(package), str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    words = ["calibrate", "a.dng", "-p", "a.lensprofile", "--json"]
    words += ["--estimator", "careful", "--selector", "everywhere"]

    done = subprocess.run([*PROGRAM, *words], cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["samples"] > 0
    assert lensmodel.Lens.load(tmp_path / "a.lensprofile").model.samples[0].estimator == "careful/1"

    with running(tmp_path / "data", LENS_ESTIMATOR="careful") as service:
        formats = service.get("/v1/formats")
        assert ("careful" in formats["estimators"], "everywhere" in formats["selectors"]) == (True, True)
        wish = {"photo_id": service.calibrated(photo, selector="everywhere")["id"]}
        made = service.http.post("/v1/corrections", json={**wish, "method": "adjoint"}).json()
        assert service.job(made["id"])["state"] == "succeeded"
        refused = service.http.post("/v1/corrections", json={**wish, "method": "none"})
        assert "adjoint" in refused.json()["detail"]
