"""Settings, read once from the environment (prefix `LENS_`).

Every setting has a default that works on one machine without anything else installed. A second
machine needs other addresses for the database and the storage, and nothing else.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from app.sandbox import account
from lensmodel.core.errors import InvalidInputError

PREFIX = "LENS_"
CLIENT_KEY = "LENS_API_KEY"  # not a setting of the service: the key that its clients send
MIB = 1024 * 1024  # bytes
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


class Settings(BaseSettings):
    """Configuration of one process; frozen, passed on, never looked up again."""

    # Unknown names in the environment that begin with `LENS_` are an error: most likely a mistyped setting
    # that the operator believes to be in force
    model_config = SettingsConfigDict(
        env_prefix=PREFIX, extra="forbid", frozen=True, use_attribute_docstrings=True
    )

    data_dir: Path = Path("lensmodel-data")
    """Folder of everything that is kept."""
    database_url: str = ""
    """SQLAlchemy address; empty = SQLite file in the data folder."""
    storage_url: str = ""
    """file:// or s3:// address of the blobs, for all machines; empty = in the data folder."""
    storage_seconds: PositiveFloat = 20.0
    """Longest that one request to an object store may take."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port to listen on; 0 takes any free one."""
    auth: Literal["auto", "keys", "none"] = "auto"
    """Who may use it: keys = whoever has a key made by `lensmodel keys`; none = anybody on this machine;
    auto = keys where others can reach it, or once there is a key."""
    allowed_hosts: str = ""
    """Names by which others reach it, comma separated: behind a proxy, or in a network."""
    max_upload_mb: PositiveInt = 512
    """Largest photo file, in MiB."""
    max_megapixels: PositiveFloat = 160.0
    """Largest photo, in millions of pixels."""
    max_stored_gb: PositiveFloat = 200.0
    """Largest total of one owner's photos and results, in GiB."""
    keep_photos: Literal["never", "always"] = "always"
    """How long the files of photos stay: never = until their work is done; always = until they are
    deleted."""
    keep_results_days: PositiveFloat = 30.0
    """How long corrections and their files stay after their end."""
    min_free_mb: NonNegativeInt = 256
    """Free disk below which uploads are refused, in MiB."""
    worker_slots: PositiveInt = Field(default_factory=lambda: os.cpu_count() or 1)
    """CPU jobs at once."""
    worker_memory_mb: int = Field(default=4096, ge=256)
    """Memory of all children of a worker, in MiB."""
    task_niceness: int = Field(default=10, ge=0, le=19)
    """How far photo work gives way to requests, as in nice(1); 0 = not at all."""
    task_user: str = "auto"
    """Account of the processes that decode photos, where a worker may change to it: a name; auto = lens-task
    if there is one, else nobody; none = that of the worker."""
    sandbox: Literal["auto", "require", "try"] = "auto"
    """Whether workers refuse to start where nothing keeps a hostile photo from other files: require; try =
    they take what there is; auto = require where keys are asked for."""
    lease_seconds: PositiveFloat = 20.0
    """A worker silent for this long is taken for dead."""
    task_seconds: PositiveFloat = 3600.0
    """Longest that a task may last, and the processor time of correcting a photo in each slot; reading its
    header may take a 90th of that, developing a 20th, estimating in one cell a 6th."""
    patches: int = Field(default=0, ge=0, le=1000)
    """Patches used from one photo; 0: as many as the estimator needs."""
    estimator: str = "default"
    """Name in the registry of blind estimators."""
    assume_single_copy: bool = False
    """Photos without a serial number belong to the one lens of that model."""
    metrics_address: str = ""
    """Where a worker serves its /metrics, such as 127.0.0.1:9000; empty: nowhere."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level that is logged."""
    log_format: Literal["text", "json"] = "text"
    """text: lines for people; json: one JSON object a line, for collectors."""

    @model_validator(mode="before")
    @classmethod
    def _no_unknown_names(cls, values: object) -> object:
        known = {PREFIX + name.upper() for name in cls.model_fields} | {CLIENT_KEY}
        for name in os.environ:
            if name.upper().startswith(PREFIX) and name.upper() not in known:
                near = difflib.get_close_matches(name.upper(), known, n=1)
                hint = f"did you mean {near[0]}?" if near else "run `lensmodel config` to see all settings"
                raise ValueError(f"unknown setting {name}: {hint}")
        return values

    @model_validator(mode="after")
    def _fit_together(self) -> Settings:
        account.find(self.task_user)
        if self.estimator != "default":
            # not at the top: heavy, and most processes never ask for another one
            from lensmodel.blind import estimators  # noqa: PLC0415

            try:
                estimators.create(self.estimator)
            except InvalidInputError as error:
                raise ValueError(str(error)) from error
        if not self.database.startswith("sqlite") and not self.storage_url:
            raise ValueError(
                "a database server means several machines, which cannot see the data folder of this one: set "
                "LENS_STORAGE_URL to s3://..., or to file://... of a folder that all of them see"
            )
        if self.auth == "none" and self.is_open_to_others:
            raise ValueError(
                f"others can reach it (host {self.host}, LENS_ALLOWED_HOSTS={self.allowed_hosts}) and "
                "LENS_AUTH=none lets everybody in: leave LENS_AUTH out and make keys by `lensmodel keys "
                "create`, or listen on 127.0.0.1 without LENS_ALLOWED_HOSTS"
            )
        return self

    @property
    def is_open_to_others(self) -> bool:
        """Whether more than this machine can reach it."""
        return bool(self.hosts) or self.host not in LOOPBACK

    @property
    def needs_keys(self) -> bool:
        """Whether everybody needs a key, whether or not there is one yet."""
        return self.auth == "keys" or (self.auth == "auto" and self.is_open_to_others)

    @property
    def needs_sandbox(self) -> bool:
        """Whether a worker must not start without an account for its children, and Landlock."""
        return self.sandbox == "require" or (self.sandbox == "auto" and self.needs_keys)

    @property
    def hosts(self) -> frozenset[str]:
        """Names by which others reach it, besides addresses and local ones."""
        return frozenset(name.strip().lower() for name in self.allowed_hosts.split(",") if name.strip())

    @property
    def database(self) -> str:
        """SQLAlchemy address of our tables."""
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'app.db'}"

    @property
    def jobs(self) -> str:
        """Address of the job engine's own tables: on a server it has a schema of its own."""
        file = f"sqlite:///{self.data_dir.resolve() / 'jobs.db'}"
        return file if self.database.startswith("sqlite") else self.database

    @property
    def storage(self) -> str:
        """Address of the blobs."""
        return self.storage_url or f"file://{self.data_dir.resolve() / 'blobs'}"


def described() -> dict[str, str]:
    """Return what each setting is for, by its name."""
    return {
        name: " ".join((field.description or "").split()) for name, field in Settings.model_fields.items()
    }
