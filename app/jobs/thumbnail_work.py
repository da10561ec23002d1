"""The small picture of a photo that has not been developed yet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from app.jobs.context import SPARE_MB, JobContext
from app.jobs.task_files import THUMBNAIL
from app.sandbox.outcome import TaskLimits
from app.store.photo_steps import photo_folder
from app.store.tables import PhotoRow


def keep_thumbnail(
    context: JobContext, photo: PhotoRow, info: dict[str, Any], path: Path, wanted: Callable[[], bool]
) -> None:
    """Store a small picture of the photo at `path`; none where it cannot be rendered."""
    limits = TaskLimits(memory_mb=2 * SPARE_MB, wall_s=context.settings.inspect_seconds)
    arguments = {"path": str(path), "kind": info["kind"], "orientation": info["metadata"]["orientation"]}
    with context.sandbox.folder() as folder:
        outcome = context.sandbox.run(
            "thumbnail", arguments, folder=folder, limits=limits, reads=[path], wanted=wanted
        )
        if outcome.ending == "ok" and (folder / THUMBNAIL).is_file():
            context.storage.put_file(f"{photo_folder(photo)}{THUMBNAIL}", folder / THUMBNAIL)
