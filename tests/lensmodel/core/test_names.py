"""Names of cameras and lenses as people say them."""

from __future__ import annotations

import pytest

from lensmodel.core.names import camera_name, full_name


@pytest.mark.parametrize(
    ("maker", "model", "name"),
    [
        ("Acme", "Acme 42mm", "Acme 42mm"),
        ("ACME", "Acme 42mm", "Acme 42mm"),
        ("Canon", "EF24mm f/1.4L", "Canon EF24mm f/1.4L"),
        (None, "42mm", "42mm"),
        ("Acme", None, "Acme"),
        (None, None, ""),
    ],
)
def test_a_maker_is_named_once(maker: str | None, model: str | None, name: str) -> None:
    assert full_name(maker, model) == name


@pytest.mark.parametrize(
    ("maker", "model", "name"),
    [
        ("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA", "Kodak Z612"),
        ("Eastman Kodak Company", "Kodak Digital Science DC50 Zoom Camera", "Kodak Digital Science DC50"),
        ("NIKON CORPORATION", "NIKON D1", "Nikon D1"),
        ("OLYMPUS IMAGING CORP.", "E-P3", "Olympus E-P3"),
        ("Hewlett-Packard", "HP Photosmart", "Hewlett-Packard HP Photosmart"),
        ("DJI", "FC300S", "DJI FC300S"),
        (None, "CAMERA", "CAMERA"),
    ],
)
def test_a_camera_is_named_without_company_and_kind(maker: str | None, model: str, name: str) -> None:
    assert camera_name(maker, model) == name
