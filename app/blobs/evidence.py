"""The normal equations of patches, read from the blobs beside the samples where a mode needs them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from app.blobs.storage import Storage
from app.store.samples import StoredSample
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.evidence import PatchEvidence

log = logging.getLogger(__name__)

MODES: Final = frozenset({"evidence", "likeliest"})
"""Modes that need them: those of the regression, which a worker need not load to know."""

MOST_BYTES: Final = 256 << 20
"""So much of one lens is kept in memory; some 10,000 patches. Older samples then answer by their kernels."""


def with_evidence(
    stored: Sequence[StoredSample],
    storage: Storage | None,
    mode: str,
    *,
    most_bytes: int = MOST_BYTES,
) -> list[StoredSample]:
    """Return the samples with their normal equations, the newest first served, if the mode asks for them.

    A blob that is gone or damaged costs its sample the evidence, not the lens its model.
    """
    if storage is None or mode not in MODES:
        return list(stored)
    found = list(stored)
    left = most_bytes
    for number in reversed(range(len(found))):
        one = found[number]
        if one.statistics_key is None:
            continue
        try:
            evidence = PatchEvidence.from_bytes(storage.get(one.statistics_key))
        except (FileNotFoundError, InvalidInputError) as error:
            log.warning("sample %d goes without its normal equations: %s", one.id, error)
            continue
        left -= evidence.autocorrelation.nbytes + evidence.crosscorrelation.nbytes
        if left < 0:
            log.info("the normal equations of %d older samples are not loaded", number + 1)
            break
        found[number] = replace(one, sample=replace(one.sample, evidence=evidence))
    return found
