"""Samples as JSON and arrays, and the profile that holds them."""

from __future__ import annotations

import contextlib
import json
import math
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.psf import TOKEN_LENGTH, EncodedPatch, PsfSample, delta
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.model.profile import PackedSamples, pack_samples, unpack_samples
from lensmodel.model.query import PAPER

SIZE = 21
GREEN = LensSettings(aperture=2.0)


@st.composite
def patches(draw: st.DrawFn) -> EncodedPatch:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    statistics, token = (rng.normal(size=n).astype(np.float16) for n in (9, TOKEN_LENGTH))
    return EncodedPatch(statistics, token, draw(st.sampled_from(("raw", "tiff", "jpeg"))))


@st.composite
def samples(draw: st.DrawFn) -> PsfSample:
    side = draw(st.sampled_from((1, 3, 7)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    taken = LensSettings(
        draw(st.none() | st.floats(0.5, 128.0)),
        draw(st.none() | st.floats(0.1, 20000.0)),
        draw(st.none() | st.just(math.inf) | st.floats(0.01, 1e4)),
        draw(st.sampled_from(CHANNELS)),
    )
    return PsfSample(
        kernel=rng.random((side, side)) + 1e-3,
        position=FieldPosition(draw(st.floats(0.0, 1.0)), draw(st.floats(-3.1, 3.1))),
        settings=taken,
        weight=draw(st.floats(0.0, 1.0)),
        photo=draw(st.text(max_size=5)),
        pixel_pitch_um=draw(st.none() | st.floats(0.5, 20.0)),
        estimator=draw(st.text(max_size=5)),
        encoded=draw(st.none() | patches()),
        error=draw(st.none() | st.floats(0.0, 1.0)),
        half_diagonal_px=draw(st.none() | st.floats(10.0, 1e5)),
    )


def through_files(packed: PackedSamples) -> PackedSamples:
    """The entries as JSON, which has no infinity."""
    return replace(packed, entries=json.loads(json.dumps(packed.entries, allow_nan=False)))


@settings(max_examples=40, deadline=None)
@given(st.lists(samples(), min_size=1, max_size=4))
def test_samples_come_back_as_they_were(given_samples: list[PsfSample]) -> None:
    back = unpack_samples(through_files(pack_samples(given_samples)))

    assert len(back) == len(given_samples)
    for one, other in zip(given_samples, back, strict=True):
        assert one.kernel.shape == other.kernel.shape
        np.testing.assert_allclose(other.kernel, one.kernel, rtol=1e-6)
        for name in PsfSample.__dataclass_fields__.keys() - {"kernel", "encoded"}:
            assert getattr(other, name) == getattr(one, name), name
        assert (one.encoded is None) == (other.encoded is None)
        if one.encoded is not None and other.encoded is not None:
            assert one.encoded.to_bytes() == other.encoded.to_bytes()


def test_the_channels_of_a_patch_share_what_it_encodes() -> None:
    patch = EncodedPatch(np.ones(700, np.float16), np.ones(TOKEN_LENGTH, np.float16))
    own = [
        PsfSample(delta(5), FieldPosition(0.5, 0.0), LensSettings(channel=c), encoded=patch) for c in CHANNELS
    ]
    packed = pack_samples(own)
    back = unpack_samples(packed)

    assert len(packed.encoded) == 1
    assert packed.encoded.shape[1] <= 4096
    assert back[0].encoded is back[1].encoded is back[2].encoded


@pytest.mark.parametrize(
    ("change", "said"),
    [
        *(({"size": side}, "kernels of side") for side in (0, 2, 7, -3)),
        *(({"encoded": patch}, "encoded patch") for patch in (3, -1, "0")),
        ({"weight": 2.0}, "weight"),
    ],
)
def test_entries_that_do_not_fit_are_refused(change: dict[str, object], said: str) -> None:
    packed = pack_samples([PsfSample(delta(5), FieldPosition(0.5, 0.0))])

    with pytest.raises((ValueError, InvalidInputError), match=said):
        unpack_samples(replace(packed, entries=[{**packed.entries[0], **change}]))


@pytest.mark.parametrize(
    "data", [b"", b"\x00", b"\x07" + bytes(400), bytes(401)[:-1], b"\x00" + b"\x00\x7c" * 300]
)
def test_other_bytes_are_no_encoded_patch(data: bytes) -> None:
    with pytest.raises(InvalidInputError):
        EncodedPatch.from_bytes(data)


@cache
def profile(count: int = 48) -> Lens:
    rng = np.random.default_rng(0)
    taken = [
        PsfSample(
            gaussian(SIZE, np.diag(rng.uniform(1.0, 4.0, 2))),
            FieldPosition(math.sqrt(rng.uniform(0.0, 0.9)), float(rng.uniform(-3.1, 3.1))),
            GREEN,
            photo=f"p{i % 3}",
        )
        for i in range(count)
    ]
    model = LensModel.fit(taken, PAPER)
    return Lens(model, {"serial": "1"}, {"p0": "a.dng"})


def test_profile_comes_back_with_the_same_answers(tmp_path: Path) -> None:
    before = profile()
    before.save(tmp_path / "a.lensprofile")
    after = Lens.load(tmp_path / "a.lensprofile")

    assert after.names == before.names
    assert after.photos == before.photos
    assert after.model.mode == before.model.mode
    for where in (FieldPosition(0.0, 0.0), FieldPosition(0.5, 2.0), FieldPosition(0.9, -1.0)):
        a, b = before.model.query(where, GREEN, SIZE), after.model.query(where, GREEN, SIZE)
        assert np.abs(a.kernel - b.kernel).max() <= 1e-6
        assert a.predicted_error == pytest.approx(b.predicted_error, rel=1e-4)


def changed(folder: Path, change: dict[str, object]) -> Path:
    """Write the profile with other parts of its document."""
    path = folder / "a.lensprofile"
    profile().save(path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts["profile.json"] = json.dumps({**json.loads(parts["profile.json"]), **change}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", b"\x80\x04pickle"])
def test_other_bytes_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.lensprofile").write_bytes(content)

    with pytest.raises(InvalidInputError, match="no lens profile"):
        Lens.load(tmp_path / "a.lensprofile")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 1, "samples": []}, "calibrate again"),
        ({"model": {"mode": "magic"}}, "no mode"),
        ({"model": 7}, "damaged"),
        ({"samples": []}, "one is needed"),
        ({"lens": 7}, "damaged"),
        ({"samples": [{"r": "far"}] * 48}, "damaged"),
        ({"samples": [{"r": 10**400}] * 48}, "damaged"),
    ],
)
def test_tampered_document_is_refused(change: dict[str, object], said: str, tmp_path: Path) -> None:
    with pytest.raises(LensModelError, match=said):
        Lens.load(changed(tmp_path, change))


def test_what_could_not_be_opened_is_not_written(tmp_path: Path) -> None:
    kernel = np.zeros((257, 257))
    kernel[128, 128] = 1.0
    model = LensModel.fit([PsfSample(kernel, FieldPosition(0.1, 0.0))])

    with pytest.raises(InvalidInputError, match="side 255"):
        Lens(model).save(tmp_path / "a.lensprofile")
    assert not list(tmp_path.iterdir())


def test_every_truncation_and_flipped_byte_is_refused_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "a.lensprofile"
    profile(3).save(path)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    damaged = [whole[: int(n)] for n in rng.integers(0, len(whole), 10)]
    for at in rng.integers(0, len(whole), 30):
        changed = bytearray(whole)
        changed[at] ^= 0xFF
        damaged.append(bytes(changed))
    for data in damaged:
        path.write_bytes(data)
        with contextlib.suppress(InvalidInputError):  # anything else fails the test
            assert len(Lens.load(path).model.samples) == 3


def test_earlier_profiles_open_without_the_photos_that_they_leave_out(tmp_path: Path) -> None:
    before = profile().model.samples
    after = Lens.load(changed(tmp_path, {"model": {"excluded": ["p1"]}})).model

    assert {sample.photo for sample in after.samples} == {sample.photo for sample in before} - {"p1"}


def test_one_long_name_costs_no_memory(tmp_path: Path) -> None:
    before = profile()
    long = replace(before.model.samples[0], photo="x" * 1_000_000)
    Lens(LensModel.fit([*before.model.samples[1:], long]), {}, {}).save(tmp_path / "long.lensprofile")

    after = Lens.load(tmp_path / "long.lensprofile")

    assert max(len(sample.photo) for sample in after.samples) == 200
