"""Reports of lenses that were lost, or that an earlier version of the program did not write."""

from __future__ import annotations

import logging
from typing import Final

from app.blobs.storage import Storage
from app.jobs.queue import Job, JobEngine
from app.store import Store
from app.store.versions import REPORTS_ROOT, report_key

log = logging.getLogger(__name__)

AGAIN: Final = 1
"""Argument that makes this a new job: the one that measured the lens has ended and is not run again."""


def ask_for_reports(store: Store, storage: Storage, engine: JobEngine) -> int:
    """Enqueue the measuring of each measured lens whose newest version has no report; return how many."""
    stored = {key for key, _ in storage.listed(REPORTS_ROOT)}
    enqueued = 0
    for lens_id, version, epoch in store.lenses.measured():
        if report_key(lens_id, version, epoch) not in stored:
            engine.enqueue(Job("measure", (lens_id, version, AGAIN)))
            enqueued += 1
    if enqueued:
        log.info("%d lenses have no report: asked for", enqueued)
    return enqueued
