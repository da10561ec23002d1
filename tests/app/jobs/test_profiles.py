"""Profiles that a running service gives and takes."""

from __future__ import annotations

from pathlib import Path

import pytest
from running import LIGHT, running, write_photo


@pytest.mark.slow  # starts a service with its workers
def test_a_profile_of_plain_kernels_is_read_by_a_confined_worker(tmp_path: Path) -> None:
    with running(tmp_path / "data", LIGHT) as service:
        lens = service.calibrated(write_photo(tmp_path / "one.dng", 1))["lens_id"]
        profile = service.http.get(f"/v1/lenses/{lens}/profile").raise_for_status().content
        other = service.calibrated(write_photo(tmp_path / "two.dng", 2), lens_serial="another")["lens_id"]

        answer = service.http.put(f"/v1/lenses/{other}/profile?any_lens=true", content=profile)

        assert answer.status_code == 202, answer.text
        assert service.job(answer.json()["id"])["state"] == "succeeded"
        assert service.get(f"/v1/lenses/{other}")["photos"] == 2
