"""Which photos may be of one lens, as far as they say."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import Camera, LensModel, LensProfile, load_profile, save_profile
from lensmodel.model.identity import Identity, difference

CANON = {"maker": "Canon", "model": "EF24mm f/1.4L II USM", "serial": "ab-1"}
BODY = Camera("Canon", "Canon EOS 5D", "0123")
COMPACT = Camera("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA", None)
IPHONE_A = Camera("Apple", "iPhone 6", "A")
PHONE = {"maker": "Apple", "model": "iPhone 6 back camera 4.15mm f/2.2"}

KODAK = Camera(None, "Kodak Z612")
ACME = {"maker": "Acme", "model": "Acme 42mm", "serial": "1"}


def test_a_lens_is_known_however_a_program_writes_its_name() -> None:
    seen = Identity({"maker": "CANON", "model": "EF 24mm F1.4L II USM", "serial": "AB-1 "})

    assert difference(Identity(CANON), seen) is None
    assert "number is AB1" in (difference(Identity(CANON), Identity({"serial": "AB1"})) or "")


@pytest.mark.parametrize(
    ("known", "seen"),
    [
        # the lens on another body
        (Identity(CANON, [BODY]), Identity(CANON, [Camera("Canon", "Canon EOS R5", "9")])),
        # unnamed, same model of camera
        (Identity(CANON, [BODY]), Identity({"maker": "Canon"}, [Camera("Canon", "EOS 5D", "77")])),
        (Identity(CANON), Identity({}, [COMPACT])),  # an older profile does not say its camera
        (Identity(CANON, [BODY]), Identity()),  # a scan says nothing
        (Identity({}, [COMPACT]), Identity({}, [COMPACT])),
        (Identity({}, [COMPACT]), Identity()),
        (Identity({"label": "my old fifty"}, [BODY]), Identity({"model": "50mm"}, [BODY])),
        (Identity(PHONE, [IPHONE_A]), Identity(PHONE, [IPHONE_A])),
        (Identity(PHONE, [Camera("Apple", "iPhone 6")]), Identity(PHONE, [IPHONE_A])),
        (Identity({}, [KODAK], [5.85]), Identity({}, [Camera("Eastman", "KODAK Z612")], [5.9])),
        (Identity({}, [KODAK], [5.85]), Identity({}, [KODAK], [23.4])),  # a compact that zooms
        (Identity(ACME, [BODY], [42.0]), Identity({"model": "acme-42mm"}, [COMPACT], [42.0])),
        (Identity(CANON, [BODY], [24.0]), Identity(CANON, [BODY], [70.0])),  # a zoom that names itself
        (Identity(focals_mm=[16.0, 35.0]), Identity(focals_mm=[24.0])),
        (Identity(), Identity(ACME, [BODY])),  # of which nothing is known yet
    ],
)
def test_nothing_speaks_against_one_lens(known: Identity, seen: Identity) -> None:
    assert difference(known, seen) is None


@pytest.mark.parametrize(
    ("known", "seen", "why"),
    [
        (
            Identity(CANON, [BODY]),
            Identity({"model": "EF35mm f/2"}, [BODY]),
            "of the EF35mm f/2, and the lens is the EF24mm",
        ),
        (Identity(ACME), Identity({"model": "Acme 42mm", "serial": "2"}), "number is 2, that of the lens 1"),
        (Identity(ACME), Identity({"maker": "Other", "model": "Acme 42mm"}), "a lens of Other"),
        (Identity(CANON, [BODY]), Identity({}, [COMPACT]), "taken with another camera, KODAK"),
        (Identity({}, [COMPACT]), Identity({}, [BODY]), "taken with another camera, Canon EOS 5D"),
        (
            Identity({}, [COMPACT]),
            Identity(CANON, [BODY]),
            "names its lens, EF24mm f/1.4L II USM ab-1, and .* none",
        ),
        (Identity(focals_mm=[24.0]), Identity(CANON), "names its lens"),
        (Identity({}, [BODY]), Identity({"model": "EF35mm f/2"}, [BODY]), "names its lens"),
        (
            Identity({"label": "my old fifty"}, [BODY]),
            Identity({"model": "50mm"}, [COMPACT]),
            "another camera, KODAK",
        ),
        (
            Identity({}, [BODY]),
            Identity({}, [Camera("Canon", "Canon EOS 5D", "77")]),
            "another copy of the camera",
        ),
        (
            Identity(PHONE, [IPHONE_A]),
            Identity(PHONE, [Camera("Apple", "iPhone 6", "B")]),
            "another copy of the camera",
        ),
        (Identity(focals_mm=[16.0, 35.0]), Identity(focals_mm=[70.0]), "70 mm, and .* of 16 to 35 mm"),
        (Identity({}, [BODY], [50.0]), Identity({}, [BODY], [24.0]), "24 mm, and .* of 50 mm"),
        (Identity(CANON, [BODY], [24.0]), Identity({}, [BODY], [50.0]), "50 mm, and .* of 24 mm"),
    ],
)
def test_another_lens_is_told(known: Identity, seen: Identity, why: str) -> None:
    assert re.match(f"its? .*{why}", difference(known, seen) or "")


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
