"""What a run over a folder found out and need not find out again: a small JSON file beside its results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from lensmodel.core.files import atomic

NAME: Final = ".lensmodel-folder.json"


class Journal:
    """Verdicts by photo, each valid as long as what it was given under is unchanged.

    Written after each verdict, complete or not at all: a run that was stopped goes on where it was.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._verdicts: dict[str, list[str]] = {}
        try:
            stored = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # none yet, or damaged: every verdict is determined anew
            return
        if isinstance(stored, dict):
            self._verdicts = {
                key: [str(text) for text in value]
                for key, value in stored.items()
                if isinstance(value, list) and len(value) == 2  # a condition and a verdict
            }

    def verdict(self, kind: str, photo: str, under: str) -> str | None:
        """Return the verdict on a photo under the same conditions, or None."""
        given, text = self._verdicts.get(f"{kind} {photo}", ["", ""])
        return text if given == under and text else None

    def note(self, kind: str, photo: str, under: str, text: str) -> None:
        """Store the verdict on a photo."""
        self._verdicts[f"{kind} {photo}"] = [under, text]
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with atomic(self._path) as file:
            file.write(json.dumps(self._verdicts, indent=1, ensure_ascii=False).encode())
