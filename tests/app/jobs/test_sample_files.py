"""Samples in the folder of a task: written by one process, read by another that trusts it or does not."""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.jobs import sample_files, tasks
from app.jobs.answers import ENCODED, KERNELS, SAMPLES
from app.jobs.sample_files import DAMAGED, MAX_SIDE, read_samples, returned_samples, write_samples
from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import TOKEN_LENGTH, EncodedPatch, PsfSample, delta
from lensmodel.core.types import FieldPosition, LensSettings

PATCH = EncodedPatch(np.ones(9, dtype=np.float16), np.ones(TOKEN_LENGTH, dtype=np.float16))
ABOUT: dict[str, Any] = {"weight": 0.25, "estimator": "quick/1", "encoded": PATCH, "error": 0.2}
SAMPLE = PsfSample(gaussian(5, np.eye(2)), FieldPosition(0.4, 0.3), LensSettings(2.8, channel="b"), **ABOUT)
Damage = Callable[[Path], object]


def test_a_returned_sample_is_that_of_the_task(tmp_path: Path) -> None:
    write_samples(tmp_path, [SAMPLE, PsfSample(delta(3), FieldPosition(0.0, 0.0))])

    first, second = returned_samples(tmp_path, count=2)

    np.testing.assert_allclose(first.kernel, SAMPLE.kernel, atol=1e-7)
    assert first.encoded is not None
    assert first.encoded.to_bytes() == PATCH.to_bytes()
    assert (first.position, first.settings, first.weight) == (SAMPLE.position, SAMPLE.settings, 0.25)
    assert (first.estimator, first.error) == ("quick/1", 0.2)
    assert (second.kernel.shape, second.encoded) == ((3, 3), None)
    assert [sample.error for sample in read_samples(tmp_path)] == [0.2, None]


def put(name: str, content: bytes | np.ndarray) -> Damage:
    """Write something else instead of a file."""
    if isinstance(content, bytes):
        return lambda folder: (folder / name).write_bytes(content)
    return lambda folder: np.save(folder / name, content)


def changed(**values: object) -> Damage:
    def damage(folder: Path) -> None:
        (entry,) = json.loads((folder / SAMPLES).read_text())
        (folder / SAMPLES).write_text(json.dumps([entry | values]))

    return damage


ARCHIVE, BOUNDLESS = io.BytesIO(), io.BytesIO()
np.savez(ARCHIVE, np.ones((1, 5, 5), dtype=np.float32))
HEAD = {"descr": "<f4", "fortran_order": False, "shape": (1, 10**9, 10**9)}
np.lib.format.write_array_header_1_0(BOUNDLESS, HEAD)


@pytest.mark.parametrize(
    "damage",
    [
        put(KERNELS, b""),
        put(KERNELS, b"PK\x03\x04" + bytes(40)),
        put(KERNELS, pickle.dumps(np.ones((1, 5, 5)))),
        put(KERNELS, ARCHIVE.getvalue()),
        put(KERNELS, BOUNDLESS.getvalue()),
        put(KERNELS, np.ones((1, 5, 5))),
        put(KERNELS, np.ones((2, 5, 5), dtype=np.float32)),
        put(KERNELS, np.ones((5, 5), dtype=np.float32)),
        put(KERNELS, np.full((1, 5, 5), np.nan, dtype=np.float32)),
        put(KERNELS, np.ones((1, MAX_SIDE + 2, MAX_SIDE + 2), dtype=np.float32)),
        put(ENCODED, np.ones((1, 3), dtype=np.uint8)),
        put(ENCODED, np.ones((1, 403), dtype=np.float32)),
        put(ENCODED, np.full((1, 403), 255, dtype=np.uint8)),
        changed(encoded=1),
        changed(encoded="0"),
        changed(size=float("inf")),
        changed(size=7),
        changed(weight=2.0),
        changed(error="small"),
        changed(r=10**400),
        changed(settings={"channel": "x"}),
        changed(settings={"zoom": 2}),
        *(put(SAMPLES, text) for text in (b"{}", b"5", b"[5]", b'["size"]', b"[" * 10**5)),
        *(lambda folder, name=name: (folder / name).unlink() for name in (SAMPLES, KERNELS)),
    ],
)
def test_whatever_a_child_wrote_instead_is_refused(tmp_path: Path, damage: Damage) -> None:
    write_samples(tmp_path, [SAMPLE])
    damage(tmp_path)

    with pytest.raises(DAMAGED):
        returned_samples(tmp_path, count=1)


def test_too_long_entries_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_samples(tmp_path, [SAMPLE])
    monkeypatch.setattr(sample_files, "MAX_RESULT", 100)

    with pytest.raises(InvalidInputError, match="larger than 100 bytes"):
        returned_samples(tmp_path, count=1)


@pytest.mark.parametrize("version", [20, 99])
def test_a_zip_that_is_no_profile_is_refused_whatever_version_it_claims(version: int, tmp_path: Path) -> None:
    path = tmp_path / "x.lensprofile"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("profile.json", "{}")
    data = bytearray(path.read_bytes())
    entry = data.find(b"PK\x01\x02")
    data[entry + 6 : entry + 8] = struct.pack("<H", version)  # that is needed to unpack it
    path.write_bytes(data)

    with pytest.raises(InvalidInputError, match="no lens profile"):
        tasks.profile({"path": str(path), "max_unpacked": 1 << 20}, tmp_path, lambda *_: None)
