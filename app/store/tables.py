"""What crosses SQL: the tables of the application database.

Text ids (`public_id`) are for the outside, integer keys stay inside. Times are UTC. The truth lies here, not
in the job engine: unique keys and conditional updates give every effect once, however often it is tried.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, ClassVar, Final, TypeAlias, get_args

from sqlalchemy import (
    JSON,
    BigInteger,
    CheckConstraint,
    DateTime,
    Dialect,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    Text,
    TypeDecorator,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, foreign, mapped_column, relationship

from app.schemas import CorrectionState, PhotoState

PHOTO_RUNNING: Final = ("inspecting", "developing", "selecting", "estimating")
PHOTO_WORKED_ON: Final = ("received", *PHOTO_RUNNING)  # costs computing time; one that waits costs space only
PHOTO_UNFINISHED: Final = (*PHOTO_WORKED_ON, "needs_lens")
CORRECTION_ACTIVE: Final = ("queued", "running")
# Kind of a photo that is none: a file of samples for a lens, which a worker reads like a photo
PROFILE_FILE: Final = "lensprofile"
ENDED_BADLY: Final = ("failed", "cancelled")  # of photos and of corrections

EVENT_KINDS: Final = ("photo_added", "photo_included", "photo_excluded", "photo_removed", "photo_changed")


def _one_of(column: str, values: tuple[str, ...]) -> str:
    return f"{column} IN ({', '.join(repr(value) for value in values)})"


def _unique(name: str, *columns: str, where: str) -> Index:
    """Let rows for which a condition holds differ in some of the columns."""
    condition = text(where)
    return Index(name, *columns, unique=True, sqlite_where=condition, postgresql_where=condition)


class UtcTime(TypeDecorator[datetime]):
    """Points in time: aware in Python, UTC in the table, also where SQL knows no zones."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Bring to UTC; naive times are a programming error."""
        del dialect
        if value is not None and value.tzinfo is None:
            raise ValueError(f"time without a zone: {value}")
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Give back with the zone that SQLite forgets."""
        del dialect
        return value.replace(tzinfo=UTC) if value is not None and value.tzinfo is None else value


class Base(DeclarativeBase):
    """Base of all tables."""

    metadata = MetaData(
        naming_convention={  # batch migrations must know the names of what they replace
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: UtcTime(),
        dict[str, Any]: JSON(),
        list[Any]: JSON(),
        str: Text(),
    }


Key: TypeAlias = Annotated[int, mapped_column(primary_key=True)]
Name: TypeAlias = Annotated[str, mapped_column(unique=True)]
OfOwner: TypeAlias = Annotated[int, mapped_column(ForeignKey("owner.id", ondelete="CASCADE"))]
OfPhoto: TypeAlias = Annotated[int, mapped_column(ForeignKey("photo.id", ondelete="CASCADE"))]
Count: TypeAlias = Annotated[int, mapped_column(default=0)]
Big: TypeAlias = Annotated[int, mapped_column(BigInteger)]
BigKey: TypeAlias = Annotated[  # SQLite counts rows only in INTEGER keys
    int, mapped_column(BigInteger().with_variant(Integer, "sqlite"), primary_key=True)
]


class OwnerRow(Base):
    """Whose photos and lenses these are."""

    __tablename__ = "owner"

    id: Mapped[Key]
    name: Mapped[Name]
    # Limit of the bytes of photos; None where the setting applies, as for `quota_photos`
    quota_bytes: Mapped[Big | None]
    quota_photos: Mapped[int | None]
    created_at: Mapped[datetime]
    erased_at: Mapped[datetime | None]  # when erasure of everything was requested; the row is deleted last


class Owned:
    """What belongs to an owner, with its id for the outside."""

    id: Mapped[Key]
    public_id: Mapped[Name]
    owner_id: Mapped[OfOwner]


class Work(Owned):
    """What workers do for an owner: how far it is, and why it ended."""

    epoch: Mapped[int] = mapped_column(default=1)  # grows when it is started anew after its end
    attempt: Mapped[Count]  # grows when a worker takes it up
    state: Mapped[str]
    stage_at: Mapped[datetime]  # when `state` last changed
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    error_code: Mapped[str | None]
    error_detail: Mapped[str | None]


class LensRow(Owned, Base):
    """One copy of a lens; `version` grows with every change of its samples."""

    __tablename__ = "lens"
    __table_args__ = (
        CheckConstraint("version >= 0", name="version"),
        UniqueConstraint("owner_id", "identity_key"),
        Index("ix_lens_page", "owner_id", "public_id"),
        {"sqlite_autoincrement": True},  # the key of a deleted lens is given to no other
    )

    maker: Mapped[str | None]
    model: Mapped[str | None]
    serial: Mapped[str | None]
    serial_source: Mapped[str]
    identity_key: Mapped[str]
    label: Mapped[str | None]
    version: Mapped[Count]
    rebuild_epoch: Mapped[Count]
    photo_count: Mapped[Count]
    sample_count: Mapped[Count]
    created_at: Mapped[datetime]

    @property
    def names(self) -> dict[str, str]:
        """What is known of its name: maker, model, serial, label."""
        names = {"maker": self.maker, "model": self.model, "serial": self.serial, "label": self.label}
        return {key: name for key, name in names.items() if name}

    def complete(self, maker: str | None, model: str | None) -> None:
        """Fill in the maker and the model where they are not known yet."""
        self.maker, self.model = self.maker or maker, self.model or model


class PhotoRow(Work, Base):
    """One uploaded photo and how far its calibration is."""

    __tablename__ = "photo"
    __table_args__ = (
        CheckConstraint(_one_of("state", get_args(PhotoState)), name="state"),
        UniqueConstraint("owner_id", "sha256"),
        Index("ix_photo_state", "state"),
        Index("ix_photo_page", "owner_id", "public_id"),
        Index("ix_photo_lens_id_state", "lens_id", "state"),
        {"sqlite_autoincrement": True},  # the key of a deleted photo is given to no other
    )

    lens_id: Mapped[int | None] = mapped_column(ForeignKey("lens.id", ondelete="SET NULL"))
    sha256: Mapped[str]
    filename: Mapped[str]
    kind: Mapped[str]
    byte_size: Mapped[Big]
    blob_key: Mapped[str]
    calibrate: Mapped[bool]
    # What the owner said about the photo; goes before what the file says
    given: Mapped[dict[str, Any]]
    width: Mapped[int | None]
    height: Mapped[int | None]
    orientation: Mapped[int | None]
    camera_maker: Mapped[str | None]
    camera_model: Mapped[str | None]
    # Digest of the camera and its serial: distinguishes bodies without identifying one
    body_key: Mapped[str | None]
    lens_maker: Mapped[str | None]
    lens_model: Mapped[str | None]
    lens_serial: Mapped[str | None]
    lens_serial_source: Mapped[str | None]
    aperture: Mapped[float | None]
    focal_mm: Mapped[float | None]
    focus_m: Mapped[float | None]  # as `app.distances` writes it
    pixel_pitch_um: Mapped[float | None]
    # Lateral colour that this photo shows: radial polynomials of red and blue
    lateral: Mapped[dict[str, Any] | None] = mapped_column("lateral_colour")  # LATERAL is a word of SQL
    patches_total: Mapped[Count]
    patches_done: Mapped[Count]
    patches_rejected: Mapped[Count]
    # How many windows were rejected before anything was estimated in them
    windows_rejected: Mapped[Count]
    # Those windows, as `app.store.photos` writes them: thousands, never queried one by one
    windows: Mapped[dict[str, Any] | None] = mapped_column(deferred=True)
    received_at: Mapped[datetime]
    # Whether the file said where it was taken: none, removed, or unknown; None until it was searched
    location: Mapped[str | None]
    # Hash of the stored file where it differs from what was sent, whose hash is `sha256`
    file_sha256: Mapped[str | None]
    file_gone_at: Mapped[datetime | None]  # when the file was deleted, see the setting `keep_photos`
    lens: Mapped[LensRow | None] = relationship()  # the lens that it was taken with, where that is known

    @property
    def folder(self) -> str:
        """Prefix of its blobs."""
        return f"{self.blob_key.rpartition('/')[0]}/"


class PatchRow(Base):
    """One window of a photo, used or rejected."""

    __tablename__ = "patch"
    __table_args__ = (
        CheckConstraint(_one_of("state", ("pending", "done", "rejected")), name="state"),
        UniqueConstraint("photo_id", "epoch", "idx"),
    )

    id: Mapped[BigKey]
    photo_id: Mapped[OfPhoto]
    epoch: Mapped[int]
    idx: Mapped[int]
    cell: Mapped[int | None]
    row: Mapped[int]
    col: Mapped[int]
    size: Mapped[int]
    r: Mapped[float]
    phi: Mapped[float]
    score: Mapped[float | None]
    state: Mapped[str]
    reason: Mapped[str | None]
    # What it says without a kernel, for all three channels: `EncodedPatch.to_bytes`
    encoded: Mapped[bytes | None] = mapped_column(deferred=True)


class SampleRow(Base):
    """One PSF estimate: the kernel of one channel of one patch."""

    # `lens_id` and `version_added` are set together when the photo is counted, and cleared when it is
    # excluded: the model reads exactly the samples that have them

    __tablename__ = "psf_sample"
    __table_args__ = (
        UniqueConstraint("patch_id", "channel"),
        Index("ix_psf_sample_lens_version", "lens_id", "version_added", "id"),
        Index("ix_psf_sample_photo_id", "photo_id"),
        {"sqlite_autoincrement": True},
    )

    id: Mapped[BigKey]
    photo_id: Mapped[OfPhoto]
    patch_id: Mapped[int] = mapped_column(ForeignKey("patch.id", ondelete="CASCADE"))
    lens_id: Mapped[int | None] = mapped_column(ForeignKey("lens.id"))
    version_added: Mapped[int | None]
    channel: Mapped[str]
    entry: Mapped[dict[str, Any]]  # what its photo's row does not know: fields of `model.profile`
    format_version: Mapped[int]
    crc32: Mapped[Big]
    psf: Mapped[bytes] = mapped_column(deferred=True)


class EventRow(Base):
    """One step of a lens's history: why its version grew."""

    __tablename__ = "calibration_event"
    __table_args__ = (
        CheckConstraint(_one_of("kind", EVENT_KINDS), name="kind"),
        UniqueConstraint("lens_id", "version"),
        _unique(
            "uq_calibration_event_counted_once", "photo_public_id", "epoch", where="kind = 'photo_added'"
        ),
    )

    id: Mapped[Key]
    lens_id: Mapped[int] = mapped_column(ForeignKey("lens.id", ondelete="CASCADE"))
    version: Mapped[int]
    kind: Mapped[str]
    photo_public_id: Mapped[str]
    epoch: Mapped[int]
    samples_added: Mapped[int]
    samples: Mapped[int]
    photos: Mapped[int]
    metrics: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime]


class CorrectionRow(Work, Base):
    """One photo to be corrected with one version of a lens's model."""

    __tablename__ = "correction"
    __table_args__ = (
        CheckConstraint(_one_of("state", get_args(CorrectionState)), name="state"),
        _unique(
            "uq_correction_params",
            *("photo_id", "lens_public_id", "lens_version", "params_hash"),
            where="state NOT IN ('failed', 'cancelled')",
        ),
        Index("ix_correction_state", "state"),
        Index("ix_correction_page", "owner_id", "public_id"),
        Index("ix_correction_lens_public_id", "lens_public_id"),
    )

    photo_id: Mapped[OfPhoto]
    lens_public_id: Mapped[str]  # stays when the lens is deleted
    lens_version: Mapped[int]
    params: Mapped[dict[str, Any]]
    params_hash: Mapped[str]
    stage: Mapped[str | None]
    progress_done: Mapped[Count]
    progress_total: Mapped[Count]
    report: Mapped[dict[str, Any] | None]
    result_key: Mapped[str | None]
    result_etag: Mapped[str | None]
    result_media_type: Mapped[str | None]
    result_bytes: Mapped[Big | None]
    result_shown_bytes: Mapped[Big] = mapped_column(default=0)  # of the pictures beside it, for pages
    result_name: Mapped[str | None]
    created_at: Mapped[datetime]
    photo: Mapped[PhotoRow] = relationship()
    lens: Mapped[LensRow | None] = relationship(
        primaryjoin=lambda: foreign(CorrectionRow.lens_public_id) == LensRow.public_id, viewonly=True
    )

    @property
    def folder(self) -> str:
        """Prefix of its blobs."""
        return f"corrections/{self.public_id}/"

    @property
    def run_folder(self) -> str:
        """Prefix of the files of its last run: no other run writes there."""
        return f"{self.folder}{self.epoch}-{self.attempt}/"


class WorkerRow(Base):
    """One worker process and the time of its last heartbeat."""

    __tablename__ = "worker"

    id: Mapped[str] = mapped_column(primary_key=True)
    heartbeat_at: Mapped[datetime]
    # Measures that confine its children: names of `app.sandbox.confine.MEASURES`, separated by spaces
    confined: Mapped[str]


class GarbageRow(Base):
    """Blobs to delete once nothing can still be reading them: all keys with this prefix."""

    __tablename__ = "blob_garbage"

    prefix: Mapped[str] = mapped_column(primary_key=True)
    not_before: Mapped[datetime]
    # Whether a worker has begun to delete them: from then on no upload may keep them
    claimed: Mapped[bool] = mapped_column(default=False)


class KeyRow(Base):
    """One key of an owner; only its hash is stored."""

    __tablename__ = "api_key"
    __table_args__ = (Index("ix_api_key_owner_id", "owner_id"),)

    id: Mapped[Key]
    owner_id: Mapped[OfOwner]
    prefix: Mapped[Name]
    key_hash: Mapped[Name]
    label: Mapped[str | None]
    # Words of `app.store.accounts.SCOPES`, separated by spaces
    scopes: Mapped[str]
    created_at: Mapped[datetime]
    last_used_at: Mapped[datetime | None]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    owner: Mapped[OwnerRow] = relationship()


class SessionRow(Base):
    """One browser that has signed in with a key; it ends with the key."""

    __tablename__ = "session"
    __table_args__ = (Index("ix_session_key_id", "key_id"),)

    token_hash: Mapped[str] = mapped_column(primary_key=True)
    key_id: Mapped[int] = mapped_column(ForeignKey("api_key.id", ondelete="CASCADE"))
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
