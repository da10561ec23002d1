"""The file of a lens profile: read by a child, as it may be hostile; its samples are checked."""

from __future__ import annotations

from typing import Final

from app.jobs.answers import ReadProfile, checked
from app.jobs.context import SPARE_MB, JobContext, JobFailedError, NotWantedError
from app.jobs.sample_files import DAMAGED, returned_samples
from app.other_lens import REMEDY, Described, difference
from app.sandbox.outcome import TaskLimits
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from app.ways import configured_way

COPIES: Final = 8
"""Times the unpacked size that reading takes (chosen, by counting): bytes, float32, float64, the model."""

MAX_UNPACKED: Final = 256 << 20
"""Bytes to which a profile may unpack (chosen): kernels of 20,000 samples of 55 pixels, which no lens has."""


def read_in(context: JobContext, file: PhotoRow) -> None:
    """Let the samples of a profile join the lens that `file` names."""
    store, settings = context.store, context.settings

    def wanted() -> bool:
        return store.photos.is_live(file.public_id, file.epoch)

    limits = TaskLimits(
        memory_mb=SPARE_MB + COPIES * (MAX_UNPACKED >> 20), wall_s=settings.develop_seconds, scratch_mb=1024
    )
    with context.original(file) as path, context.sandbox.folder() as folder:
        arguments = {"path": str(path), "max_unpacked": MAX_UNPACKED}
        try:
            answer = context.attempt(
                "profile", arguments, folder=folder, limits=limits, wanted=wanted, reads=[path]
            )
        except JobFailedError as error:
            if error.code != "invalid_parameter":
                raise
            raise JobFailedError("malformed_upload", error.detail) from error
        read = checked(ReadProfile, answer)
        try:
            samples = returned_samples(folder, count=read["samples"])
        except DAMAGED as error:
            raise JobFailedError("internal_error", f"the profile gave no kernels: {error}") from error
    lens = store.lenses.get(file.given["lens_id"], ANY_OWNER)
    if lens is None:
        raise JobFailedError("unknown_lens", "the lens was deleted meanwhile: send the profile to another")
    if configured_way(settings, lens.way).mode != read["mode"]:
        text = f"the profile was learned with the model {read['mode']}, lens {lens.public_id} with {lens.way}"
        raise JobFailedError("conflict", f"{text}: send it to a lens of that model")
    if not file.given.get("any_lens"):
        focals = store.lenses.coverage_of([lens])[lens.id][1]
        named = {name: read["lens"].get(name) for name in ("maker", "model", "serial")}
        other = Described(**named, focals_mm={s.settings.focal_mm for s in samples if s.settings.focal_mm})
        why = difference(Described(lens.maker, lens.model, lens.serial, focals_mm=focals), other)
        if why is not None:
            raise JobFailedError("other_lens", f"the profile seems to be of another lens: {why}; {REMEDY}")
    names = {key: name for key, name in read["photos"].items() if name.isprintable()}
    if store.patches.take_in(file, samples, names) is None:
        raise NotWantedError
