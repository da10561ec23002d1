"""Reports and fitted models of lenses that an earlier version of the program measured, or that were lost."""

from __future__ import annotations

import logging
from typing import Final

from app.blobs.storage import Storage
from app.jobs.queue import Job, JobEngine
from app.store import Store
from app.store.versions import LEARNED_ROOT, LEARNED_VERSION, learned_key, report_key

log = logging.getLogger(__name__)

AGAIN: Final = LEARNED_VERSION
"""Argument that makes this a new job, once for each version of the program: the one that measured the lens
has ended and is not run again."""


def ask_for_reports(store: Store, storage: Storage, engine: JobEngine) -> int:
    """Enqueue the measuring of each measured lens whose newest version lacks something; return how many."""
    stored = {key for key, _ in storage.listed(LEARNED_ROOT)}
    enqueued = 0
    for lens_id, version, epoch in store.lenses.measured():
        wanted = {report_key(lens_id, version, epoch), learned_key(lens_id, version, epoch)}
        if not wanted <= stored:
            engine.enqueue(Job("measure", (lens_id, version, AGAIN)))
            enqueued += 1
    if enqueued:
        log.info("%d lenses have no report or no fitted model of this version: asked for", enqueued)
    return enqueued
