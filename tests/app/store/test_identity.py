"""Which photos may be of one lens, as far as they say."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import Camera, LensModel, LensProfile, load_profile, save_profile
from lensmodel.workflow.calibrating import Identity, difference

CANON = {"maker": "Canon", "model": "EF24mm f/1.4L II USM", "serial": "ab-1"}
BODY = Camera("Canon", "Canon EOS 5D", "0123")
COMPACT = Camera("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA", None)
PHONE = {"maker": "Apple", "model": "iPhone 6 back camera 4.15mm f/2.2"}


def test_a_lens_is_known_however_a_program_writes_its_name() -> None:
    seen = Identity({"maker": "CANON", "model": "EF 24mm F1.4L II USM", "serial": "AB-1 "})

    assert difference(CANON, (), seen) is None
    assert "serial AB1" in (difference(CANON, (), Identity({"serial": "AB1"})) or "")


@pytest.mark.parametrize(
    ("known", "cameras", "seen"),
    [
        (CANON, (BODY,), Identity(CANON, Camera("Canon", "Canon EOS R5", "9"))),  # the lens on another body
        (
            CANON,
            (BODY,),
            Identity({"maker": "Canon"}, Camera("Canon", "EOS 5D", "77")),
        ),  # unnamed, same model
        (CANON, (), Identity({}, COMPACT)),  # an older profile does not say its camera
        (CANON, (BODY,), Identity()),  # a scan says nothing
        ({}, (COMPACT,), Identity({}, COMPACT)),
        ({}, (COMPACT,), Identity()),
        ({"label": "my old fifty"}, (BODY,), Identity({"model": "50mm"}, BODY)),
        (PHONE, (Camera("Apple", "iPhone 6", "A"),), Identity(PHONE, Camera("Apple", "iPhone 6", "A"))),
        (PHONE, (Camera("Apple", "iPhone 6"),), Identity(PHONE, Camera("Apple", "iPhone 6", "A"))),
    ],
)
def test_nothing_speaks_against_one_lens(
    known: dict[str, str], cameras: tuple[Camera, ...], seen: Identity
) -> None:
    assert difference(known, cameras, seen) is None


@pytest.mark.parametrize(
    ("known", "cameras", "seen", "why"),
    [
        (CANON, (BODY,), Identity({"model": "EF35mm f/2"}, BODY), "another lens, model EF35mm"),
        (CANON, (BODY,), Identity({}, COMPACT), "names no lens and was taken with another camera, KODAK"),
        ({}, (COMPACT,), Identity({}, BODY), "taken with another camera, Canon EOS 5D"),
        ({}, (COMPACT,), Identity(CANON, BODY), "names its lens, EF24mm f/1.4L II USM ab-1, and .* none"),
        ({}, (), Identity(CANON), "names its lens"),
        ({}, (BODY,), Identity({"model": "EF35mm f/2"}, BODY), "names its lens"),
        ({}, (BODY,), Identity({}, Camera("Canon", "Canon EOS 5D", "77")), "another copy of the camera"),
        (
            PHONE,
            (Camera("Apple", "iPhone 6", "A"),),
            Identity(PHONE, Camera("Apple", "iPhone 6", "B")),
            "another copy of the camera, serial B",
        ),
    ],
)
def test_another_lens_is_told(
    known: dict[str, str], cameras: tuple[Camera, ...], seen: Identity, why: str
) -> None:
    assert re.match(f"it .*{why}", difference(known, cameras, seen) or "")


def model() -> LensModel:
    places = [FieldPosition(r, phi) for r in (0.1, 0.5, 0.9) for phi in (-2.0, 0.5, 2.5)]
    return LensModel.fit(
        [PsfSample(gaussian(15, np.eye(2)), place, LensSettings(2.8), photo="x") for place in places]
    )


def test_a_profile_remembers_its_cameras(tmp_path: Path) -> None:
    path = tmp_path / "a.lensprofile"
    save_profile(path, LensProfile(model(), {}, {"x": "x.jpg"}, (BODY, COMPACT)))

    assert load_profile(path).cameras == (BODY, COMPACT)


def test_a_profile_without_cameras_is_read_as_before(tmp_path: Path) -> None:
    path, old = tmp_path / "a.lensprofile", tmp_path / "old.lensprofile"
    save_profile(path, LensProfile(model(), CANON, {"x": "x.jpg"}, (BODY,)))
    with zipfile.ZipFile(path) as new, zipfile.ZipFile(old, "w") as written:
        for name in new.namelist():
            data = new.read(name)
            if name == "profile.json":
                document = json.loads(data)
                del document["cameras"]
                data = json.dumps(document).encode()
            written.writestr(name, data)

    assert load_profile(old).cameras == ()
    assert load_profile(old).lens == CANON
