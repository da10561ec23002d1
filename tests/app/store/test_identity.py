"""Which photos may be of one lens, as far as they say."""

from __future__ import annotations

import re

import pytest

from lensmodel.model.identity import Camera, Identity, difference

CANON = {"maker": "Canon", "model": "EF24mm f/1.4L II USM", "serial": "ab-1"}
ACME = {"maker": "Acme", "model": "Acme 42mm", "serial": "1"}
LABELLED = {"label": "my old fifty"}
PHONE = {"maker": "Apple", "model": "iPhone 6 back camera 4.15mm f/2.2"}

EOS = Camera("Canon", "Canon EOS 5D", "0123")
OTHER_EOS = Camera("Canon", "Canon EOS 5D", "77")
COMPACT = Camera("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA", None)
KODAK = Camera(None, "Kodak Z612")
IPHONE, IPHONE_A, IPHONE_B = (Camera("Apple", "iPhone 6", serial) for serial in (None, "A", "B"))

SAYS_NOTHING, EF35_ON_EOS = Identity(), Identity({"model": "EF35mm f/2"}, [EOS])
CANON_ON_EOS, OF_EOS, OF_COMPACT = Identity(CANON, [EOS]), Identity({}, [EOS]), Identity({}, [COMPACT])


def test_a_lens_is_known_however_a_program_writes_its_name() -> None:
    seen = Identity({"maker": "CANON", "model": "EF 24mm F1.4L II USM", "serial": "AB-1 "})

    assert difference(Identity(CANON), seen) is None
    assert "number is AB1" in (difference(Identity(CANON), Identity({"serial": "AB1"})) or "")


@pytest.mark.parametrize(
    ("known", "seen"),
    [
        (CANON_ON_EOS, Identity(CANON, [Camera("Canon", "Canon EOS R5", "9")])),  # on another body
        # unnamed, of the same model
        (CANON_ON_EOS, Identity({"maker": "Canon"}, [Camera("Canon", "EOS 5D", "77")])),
        (Identity(CANON), OF_COMPACT),  # a profile need not say its camera
        (CANON_ON_EOS, SAYS_NOTHING),  # as a scan
        (Identity(LABELLED, [EOS]), Identity({"model": "50mm"}, [EOS])),
        (Identity(PHONE, [IPHONE]), Identity(PHONE, [IPHONE_A])),
        (Identity({}, [KODAK], [5.85]), Identity({}, [KODAK], [23.4])),  # a compact that zooms
        (Identity(ACME, [EOS], [42.0]), Identity({"model": "acme-42mm"}, [COMPACT], [42.0])),
        (Identity(CANON, [EOS], [24.0]), Identity(CANON, [EOS], [70.0])),  # a zoom that names itself
        (Identity(focals_mm=[16.0, 35.0]), Identity(focals_mm=[24.0])),
        (SAYS_NOTHING, Identity(ACME, [EOS])),  # of which nothing is known yet
    ],
)
def test_nothing_speaks_against_one_lens(known: Identity, seen: Identity) -> None:
    assert difference(known, seen) is None


@pytest.mark.parametrize(
    ("known", "seen", "why"),
    [
        (CANON_ON_EOS, EF35_ON_EOS, "of the EF35mm f/2, and the lens is the EF24mm"),
        (Identity(ACME), Identity(ACME | {"serial": "2"}), "number is 2, that of the lens 1"),
        (Identity(ACME), Identity({"maker": "Other", "model": "Acme 42mm"}), "a lens of Other"),
        (CANON_ON_EOS, OF_COMPACT, "taken with another camera, KODAK"),
        (OF_COMPACT, CANON_ON_EOS, "names its lens, EF24mm f/1.4L II USM ab-1, and .* none"),
        (Identity(focals_mm=[24.0]), Identity(CANON), "names its lens"),
        (Identity(LABELLED, [EOS]), Identity({"model": "50mm"}, [COMPACT]), "another camera, KODAK"),
        (OF_EOS, Identity({}, [OTHER_EOS]), "another copy of the camera"),
        (Identity(PHONE, [IPHONE_A]), Identity(PHONE, [IPHONE_B]), "another copy of the camera"),
        (Identity(focals_mm=[16.0, 35.0]), Identity(focals_mm=[70.0]), "70 mm, and .* of 16 to 35 mm"),
        (Identity(CANON, [EOS], [24.0]), Identity({}, [EOS], [50.0]), "50 mm, and .* of 24 mm"),
    ],
)
def test_another_lens_is_told(known: Identity, seen: Identity, why: str) -> None:
    assert re.match(f"its? .*{why}", difference(known, seen) or "")
