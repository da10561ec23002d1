"""`lensmodel correct --server URL`: the work is done elsewhere, the results come here."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from in_process import lensmodel
from running import Service, write_photo


def test_a_service_that_does_not_answer_is_wrong_usage(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.dng", 1)
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}"
        done = lensmodel("correct", "a.dng", "--server", url, cwd=tmp_path)

    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert url in done.stderr


@pytest.mark.slow
def test_a_folder_is_learned_from_and_corrected_by_a_service(tmp_path: Path) -> None:
    (tmp_path / "holiday").mkdir()
    write_photo(tmp_path / "holiday" / "a.dng", 1)
    write_photo(tmp_path / "holiday" / "b.dng", 2)
    (tmp_path / "holiday" / "broken.dng").write_bytes(b"no photo")
    service = Service(tmp_path / "data")
    service.start()
    try:
        words = ("correct", "holiday", "--server", service.info()["url"], "--method", "fast")
        done = lensmodel(*words, cwd=tmp_path)
        again = lensmodel(*words, cwd=tmp_path)
    finally:
        service.close()

    assert done.returncode == 1  # for the file that is no photo
    assert done.stdout.splitlines() == [
        str(Path("holiday") / "corrected" / f"{name}-corrected.tif") for name in "ab"
    ]
    assert "broken.dng" in done.stderr
    assert again.stdout == ""
