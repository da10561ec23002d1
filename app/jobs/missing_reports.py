"""Reports for lenses that were measured before reports existed, or whose report was lost."""

from __future__ import annotations

import logging
from typing import Final

from app.blobs.storage import Storage
from app.jobs.queue import Job, JobEngine
from app.store import Store
from app.store.versions import LEARNED_ROOT, report_key

log = logging.getLogger(__name__)

AGAIN: Final = 1
"""Argument that makes this a new job: the one that measured the version has ended and is not run again."""


def ask_for_reports(store: Store, storage: Storage, engine: JobEngine) -> int:
    """Enqueue the report of each lens whose newest version was measured and has none; return how many."""
    stored = {key for key, _ in storage.listed(LEARNED_ROOT)}
    enqueued = 0
    for lens_id, version, epoch in store.lenses.measured():
        if report_key(lens_id, version, epoch) not in stored:
            engine.enqueue(Job("measure", (lens_id, version, AGAIN)))
            enqueued += 1
    if enqueued:
        log.info("%d lenses have no report yet: asked for", enqueued)
    return enqueued
