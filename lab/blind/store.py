"""Finished cases of the blind benchmark, so that a run that was stopped goes on."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.blind.judges import Judge
from lab.blind.results import PROTOCOL, BlindBenchmark, CaseResult, plain
from lab.cases import BlindCase
from lensmodel.core.types import Kernel
from lensmodel.estimation import PsfEstimator

logger = logging.getLogger(__name__)


class ResultStore:
    """Finished results by the content they came from; one file of JSON lines, only ever appended."""

    def __init__(
        self, folder: Path | None, photos: Sequence[Path], settings: BlindBenchmark, judge: Judge
    ) -> None:
        self._content = {photo: hashlib.sha256(photo.read_bytes()).hexdigest() for photo in photos}
        self._settings, self._judge = settings, judge
        self._known: dict[str, CaseResult] = {}
        self._file: Path | None = None
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = folder / "blind.jsonl"
            self._known = dict(_stored(self._file)) if self._file.exists() else {}

    def find(
        self, case: BlindCase, kernel: Kernel, name: str, method: PsfEstimator | None
    ) -> CaseResult | None:
        """Return the stored result, or None."""
        return self._known.get(self._key(case, kernel, name, method))

    def add(self, case: BlindCase, kernel: Kernel, method: PsfEstimator | None, result: CaseResult) -> None:
        """Keep a result, and write it out at once."""
        key = self._key(case, kernel, result.method, method)
        self._known[key] = result
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as out:
                out.write(json.dumps({"key": key, **plain(asdict(result))}) + "\n")

    def _key(self, case: BlindCase, kernel: Kernel, name: str, method: PsfEstimator | None) -> str:
        described = repr(method) if is_dataclass(method) else type(method).__qualname__
        parts = (
            PROTOCOL,
            [self._content[photo] for photo in case.photos],
            # The window is drawn by the photo's name.
            [photo.stem for photo in case.photos],
            hashlib.sha256(np.ascontiguousarray(kernel).tobytes()).hexdigest(),
            (case.psf_number, case.noise, case.patch, case.variant, case.seed),
            (name, getattr(method, "version", 0), described, self._settings.kernel_size),
            repr(self._judge),
            *(() if case.choice == "random" else (case.choice,)),
            *((case.window,) if case.window else ()),
        )
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _stored(file: Path) -> Iterator[tuple[str, CaseResult]]:
    names = [field.name for field in fields(CaseResult)]
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            values: dict[str, Any] = {name: math.nan if row[name] is None else row[name] for name in names}
            yield row["key"], CaseResult(**values)
        except (ValueError, KeyError, TypeError):
            # The last line of a run that was killed while writing.
            logger.warning("skipped a damaged line of %s", file)
