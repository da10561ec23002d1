"""What speaks against one lens."""

from __future__ import annotations

import pytest

from app.other_lens import Described, difference

KODAK = Described(cameras=["Kodak Z612"], focals_mm=[5.85])
ACME = Described("Acme", "Acme 42mm", "1", ["Nikon D1"], [42.0])


@pytest.mark.parametrize(
    ("lens", "other", "reason"),
    [
        (KODAK, Described("Acme", "Acme 42mm", "1", (), [42.0]), "of 42 mm, and the photos of the lens"),
        (KODAK, Described(cameras=["Canon EOS D30"]), "taken with a Canon EOS D30"),
        (ACME, Described("Acme", "Acme 42mm", "2"), "its serial number is 2"),
        (ACME, Described("Acme", "Acme 50mm"), "it is of the Acme 50mm"),
        (ACME, Described("Other", "Acme 42mm"), "a lens of Other"),
        (Described(focals_mm=[16.0, 35.0]), Described(focals_mm=[70.0]), "of 16 to 35 mm"),
    ],
)
def test_another_lens_is_named_with_its_reason(lens: Described, other: Described, reason: str) -> None:
    assert reason in (difference(lens, other) or "")


@pytest.mark.parametrize(
    ("lens", "other"),
    [
        (KODAK, Described(cameras=["KODAK Z612"], focals_mm=[5.9])),
        (ACME, Described("ACME", "acme-42mm", "1", ["Canon EOS D30"], [42.0])),  # on another camera
        (Described(focals_mm=[16.0, 35.0]), Described(focals_mm=[24.0])),
        (Described(), ACME),  # of which nothing is known yet
        (ACME, Described()),
    ],
)
def test_nothing_speaks_against_one_lens(lens: Described, other: Described) -> None:
    assert difference(lens, other) is None
