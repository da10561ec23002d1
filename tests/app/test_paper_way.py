"""A lens of the paper's model from photo to corrected photo, in real processes with the real estimator."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import tifffile
from running import running, write_photo

from lensmodel.model.profile import read_profile


@pytest.mark.slow  # the paper's estimator on the smallest photo, and loops to compile: a minute and a half
def test_a_lens_goes_the_papers_way(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "first.dng", 0)
    with running(tmp_path / "data") as service:
        counted = service.calibrated(photo, model="paper", selector="good-regions")
        lens = f"/v1/lenses/{counted['lens_id']}"
        exported = read_profile(io.BytesIO(service.http.get(f"{lens}/profile").content), "The answer")
        answer = service.get(f"{lens}/psf", params={"r": 0.4, "aperture": 2.8, "size": 55})
        asked = service.http.post("/v1/corrections", json={"photo_id": counted["id"]}).json()
        assert service.job(asked["id"])["state"] == "succeeded"
        result = service.http.get(f"/v1/corrections/{asked['id']}/result").content
        report = service.get(f"/v1/corrections/{asked['id']}")["report"]

        assert (answer["support"]["model"], answer["support"]["answered_by"]) == ("paper", "paper")
        assert exported.model.settings.mode == "paper"
        assert {s.estimator.partition("/")[0] for s in exported.model.samples} == {"michaeli-irani"}
        assert {s.kernel.shape for s in exported.model.samples} == {(55, 55)}
        with tifffile.TiffFile(io.BytesIO(result)) as file:
            assert "method paper" in str(file.pages[0].tags[270].value)  # type: ignore[union-attr]  # a page
        assert report["audit"]["tiles"] == []  # Richardson-Lucy alone
        size = np.array(answer["psf"]["data"]).shape

    assert size == (55, 55)
