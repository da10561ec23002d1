from __future__ import annotations

import csv
from pathlib import Path

import pytest

from lensmodel import photo

# Two models that EXPECTED.tsv gives as ExifTool's own look-up, not as text in the file.
_LOOKED_UP = {"61182", "Unknown (00 77 48 5C 80 24 24 0E)"}


@pytest.mark.tools
def test_metadata_agree_with_the_table_of_expected_values(shared_data: Path) -> None:
    with (shared_data / "meta" / "EXPECTED.tsv").open(encoding="utf-8") as table:
        rows = list(csv.DictReader(table, delimiter="\t", quoting=csv.QUOTE_NONE))
    assert len(rows) == 21
    for row in rows:
        seen = photo.read_metadata(shared_data / row["file"])
        serials = {
            part.partition("=")[2].strip()
            for part in row["lens_serial_exiftool(group=value)"].split("|")
            if row["serial_verdict"] == "usable"
        }
        assert {seen.lens.serial} == (serials or {None}), row["file"]
        assert (seen.camera_maker or "") == row["make"], row["file"]
        assert (seen.camera_model or "") == row["model"], row["file"]
        assert (seen.aperture or 0.0) == pytest.approx(float(row["f_number"] or 0)), row["file"]
        assert (seen.focal_mm or 0.0) == pytest.approx(
            float(row["focal_length"].removesuffix(" mm") or 0), abs=0.05
        ), row["file"]
        assert (seen.iso or 0) == float(row["iso"] or 0), row["file"]
        if row["body_serial"]:
            assert seen.body_serial == row["body_serial"], row["file"]
        if row["lens"] not in _LOOKED_UP:
            assert (seen.lens.model or "") == row["lens"], row["file"]
