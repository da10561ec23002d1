"""What the service says of itself."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.schemas.fields import Model


class Health(Model):
    """The process lives."""

    status: Literal["ok"] = "ok"


class Readiness(Model):
    """Whether work can be taken, and what is missing."""

    status: Literal["ready", "not ready"]
    checks: dict[str, str]
    sandbox: dict[str, bool] = Field(
        description="Which measures of the kernel confine what decodes photos, in all workers."
    )


class VersionOut(Model):
    """What runs here."""

    name: str
    version: str
    api: str
    schema_revision: str | None


class FormatsOut(Model):
    """What can be read and written, and the methods by name."""

    read: list[str]
    write: list[str]
    color_spaces: list[str]
    psf: list[str]
    methods: list[str]
    estimators: list[str]
    selectors: list[str]


class LimitsOut(Model):
    """How much of everything."""

    max_upload_bytes: int
    max_megapixels: float
    max_queued_photos: int
    max_stored_bytes: int
    max_psf_size: int
    long_poll_seconds: float
    keep_results_days: float
