"""What `lensmodel report -o` writes besides its first pictures: the lens test, and a comparison."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from lensmodel.core.codec import to_json
from lensmodel.core.files import write_atomically
from lensmodel.model.profile import LensProfile
from lensmodel.photo import develop
from lensmodel.report import bootstrap
from lensmodel.report.comparison import Side, compare
from lensmodel.report.documents import comparison_html, to_html
from lensmodel.report.lens_test import LensTest, lens_test
from lensmodel.report.pdf import comparison_pdf, to_pdf
from lensmodel.report.tables import to_csv
from lensmodel.workflow.pipeline import lateral_of

FILES: Final = ("lens-test.html", "lens-test.pdf", "lens-test.csv", "lens-test.json")
COMPARED: Final = ("comparison.html", "comparison.pdf")


def tested(profile: LensProfile, path: Path, aspect: float, photos: Sequence[Path]) -> LensTest:
    """Test the lens of a profile; its lateral colour is measured on the photos, if there are any."""
    words = [profile.lens[key] for key in ("maker", "model") if profile.lens.get(key)]
    name = profile.lens.get("label") or " ".join(words) or path.stem
    lateral = [lateral_of(develop(photo)) for photo in photos]
    return lens_test(profile.model, name, aspect=aspect, lateral=lateral, draws=bootstrap.DRAWS)


def write(folder: Path, test: LensTest) -> list[str]:
    """Write a lens test; return the names of the files that were left out, since reportlab is missing."""
    writers: dict[str, Callable[[], bytes]] = {
        "lens-test.html": lambda: to_html(test).encode(),
        "lens-test.csv": lambda: to_csv(test).encode(),
        "lens-test.json": lambda: json.dumps(to_json(test), indent=1).encode(),
        "lens-test.pdf": lambda: to_pdf(test),
    }
    return _written(folder, writers)


def write_comparison(folder: Path, first: LensTest, second: LensTest, aperture: float | None) -> list[str]:
    """Write two lens tests beside each other; return as `write`."""
    comparison = compare(Side(first.name, first.at(aperture)), Side(second.name, second.at(aperture)))
    return _written(
        folder,
        {
            "comparison.html": lambda: comparison_html(comparison).encode(),
            "comparison.pdf": lambda: comparison_pdf(comparison),
        },
    )


def _written(folder: Path, writers: dict[str, Callable[[], bytes]]) -> list[str]:
    missing = []
    for name, write_bytes in writers.items():
        try:
            data = write_bytes()
        except ModuleNotFoundError:
            missing.append(name)
            continue
        write_atomically(folder / name, data)
    return missing
