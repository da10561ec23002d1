"""Reports for lenses that were measured before there were reports, or whose report was lost."""

from __future__ import annotations

import logging
from typing import Final

from app.blobs.storage import Storage
from app.jobs.queue import Job, JobEngine
from app.store import Store
from app.store.versions import LEARNED_ROOT, report_key

log = logging.getLogger(__name__)

AGAIN: Final = 1
"""Makes the job another one than that which measured the version first: a job that ended is not run again."""


def ask_for_reports(store: Store, storage: Storage, engine: JobEngine) -> int:
    """Ask for the report of each lens whose newest version was measured and has none; return how many."""
    there = {key for key, _ in storage.listed(LEARNED_ROOT)}
    asked = 0
    for lens_id, version, epoch in store.lenses.measured():
        if report_key(lens_id, version, epoch) not in there:
            engine.enqueue(Job("measure", (lens_id, version, AGAIN)))
            asked += 1
    if asked:
        log.info("%d lenses have no report yet: asked for", asked)
    return asked
