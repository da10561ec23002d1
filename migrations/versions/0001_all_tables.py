"""All tables.

Revision: 0001, the first
"""

from __future__ import annotations

from typing import Final

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

TIME: Final = sa.DateTime(timezone=True)
KEY: Final = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "blob_garbage",
        sa.Column("prefix", sa.Text(), nullable=False),
        sa.Column("not_before", TIME, nullable=False),
        sa.Column("claimed", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.PrimaryKeyConstraint("prefix", name=op.f("pk_blob_garbage")),
    )
    op.create_table(
        "owner",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("quota_bytes", sa.BigInteger(), nullable=True),
        sa.Column("quota_photos", sa.Integer(), nullable=True),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("erased_at", TIME, nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_owner")),
        sa.UniqueConstraint("name", name=op.f("uq_owner_name")),
    )
    op.create_table(
        "worker",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("host", sa.Text(), nullable=False),
        sa.Column("pid", sa.Integer(), nullable=False),
        sa.Column("pid_started", sa.Double(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("started_at", TIME, nullable=False),
        sa.Column("heartbeat_at", TIME, nullable=False),
        sa.Column("confined", sa.String(length=200), server_default="", nullable=False),
        sa.CheckConstraint("state IN ('live', 'dead')", name=op.f("ck_worker_state")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_worker")),
    )
    op.create_table(
        "api_key",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("owner_id", sa.Integer(), nullable=False),
        sa.Column("prefix", sa.String(length=20), nullable=False),
        sa.Column("key_hash", sa.String(length=200), nullable=False),
        sa.Column("label", sa.Text(), nullable=True),
        sa.Column("scopes", sa.String(length=60), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("last_used_at", TIME, nullable=True),
        sa.Column("expires_at", TIME, nullable=True),
        sa.Column("revoked_at", TIME, nullable=True),
        sa.ForeignKeyConstraint(["owner_id"], ["owner.id"], name=op.f("fk_api_key_owner_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_api_key")),
        sa.UniqueConstraint("key_hash", name=op.f("uq_api_key_key_hash")),
        sa.UniqueConstraint("prefix", name=op.f("uq_api_key_prefix")),
    )
    op.create_index("ix_api_key_owner_id", "api_key", ["owner_id"], unique=False)
    op.create_table(
        "lens",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("public_id", sa.String(length=40), nullable=False),
        sa.Column("owner_id", sa.Integer(), nullable=False),
        sa.Column("maker", sa.Text(), nullable=True),
        sa.Column("model", sa.Text(), nullable=True),
        sa.Column("serial", sa.Text(), nullable=True),
        sa.Column("serial_source", sa.String(length=20), nullable=False),
        sa.Column("identity_key", sa.Text(), nullable=False),
        sa.Column("label", sa.Text(), nullable=True),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("rebuild_epoch", sa.Integer(), nullable=False),
        sa.Column("photo_count", sa.Integer(), nullable=False),
        sa.Column("sample_count", sa.Integer(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("deleted_at", TIME, nullable=True),
        sa.CheckConstraint("version >= 0", name=op.f("ck_lens_version")),
        sa.ForeignKeyConstraint(["owner_id"], ["owner.id"], name=op.f("fk_lens_owner_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_lens")),
        sa.UniqueConstraint("public_id", name=op.f("uq_lens_public_id")),
    )
    op.create_index("ix_lens_page", "lens", ["owner_id", "public_id"], unique=False)
    op.create_index(
        "uq_lens_identity",
        "lens",
        ["owner_id", "identity_key"],
        unique=True,
        sqlite_where=sa.text("deleted_at IS NULL"),
        postgresql_where=sa.text("deleted_at IS NULL"),
    )
    op.create_table(
        "calibration_event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("lens_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("photo_public_id", sa.String(length=40), nullable=False),
        sa.Column("epoch", sa.Integer(), nullable=False),
        sa.Column("samples_added", sa.Integer(), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("photos", sa.Integer(), nullable=False),
        sa.Column("metrics", sa.JSON(), nullable=True),
        sa.Column("created_at", TIME, nullable=False),
        sa.CheckConstraint(
            "kind IN ('photo_added', 'photo_included', 'photo_excluded', 'photo_removed', 'photo_changed')",
            name=op.f("ck_calibration_event_kind"),
        ),
        sa.ForeignKeyConstraint(["lens_id"], ["lens.id"], name=op.f("fk_calibration_event_lens_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_calibration_event")),
        sa.UniqueConstraint("lens_id", "version", name=op.f("uq_calibration_event_lens_id_version")),
    )
    op.create_index(
        "uq_calibration_event_counted_once",
        "calibration_event",
        ["photo_public_id", "epoch"],
        unique=True,
        sqlite_where=sa.text("kind = 'photo_added'"),
        postgresql_where=sa.text("kind = 'photo_added'"),
    )
    op.create_table(
        "photo",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("public_id", sa.String(length=40), nullable=False),
        sa.Column("owner_id", sa.Integer(), nullable=False),
        sa.Column("lens_id", sa.Integer(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("filename", sa.Text(), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("byte_size", sa.BigInteger(), nullable=False),
        sa.Column("blob_key", sa.Text(), nullable=False),
        sa.Column("calibrate", sa.Boolean(), nullable=False),
        sa.Column("given", sa.JSON(), nullable=False),
        sa.Column("width", sa.Integer(), nullable=True),
        sa.Column("height", sa.Integer(), nullable=True),
        sa.Column("orientation", sa.Integer(), nullable=True),
        sa.Column("camera_maker", sa.Text(), nullable=True),
        sa.Column("camera_model", sa.Text(), nullable=True),
        sa.Column("body_key", sa.String(length=16), nullable=True),
        sa.Column("lens_maker", sa.Text(), nullable=True),
        sa.Column("lens_model", sa.Text(), nullable=True),
        sa.Column("lens_serial", sa.Text(), nullable=True),
        sa.Column("lens_serial_source", sa.String(length=20), nullable=True),
        sa.Column("aperture", sa.Double(), nullable=True),
        sa.Column("focal_mm", sa.Double(), nullable=True),
        sa.Column("focus_m", sa.Double(), nullable=True),
        sa.Column("pixel_pitch_um", sa.Double(), nullable=True),
        sa.Column("lateral_colour", sa.JSON(), nullable=True),
        sa.Column("epoch", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=20), nullable=False),
        sa.Column("error_code", sa.String(length=40), nullable=True),
        sa.Column("error_detail", sa.Text(), nullable=True),
        sa.Column("patches_total", sa.Integer(), nullable=False),
        sa.Column("patches_done", sa.Integer(), nullable=False),
        sa.Column("patches_rejected", sa.Integer(), nullable=False),
        sa.Column("windows_rejected", sa.Integer(), nullable=False),
        sa.Column("windows", sa.JSON(), nullable=True),
        sa.Column("received_at", TIME, nullable=False),
        sa.Column("started_at", TIME, nullable=True),
        sa.Column("stage_at", TIME, nullable=False),
        sa.Column("finished_at", TIME, nullable=True),
        sa.Column("counted_at", TIME, nullable=True),
        sa.Column("deleted_at", TIME, nullable=True),
        sa.Column("location", sa.String(length=10), nullable=True),
        sa.Column("file_sha256", sa.String(length=64), nullable=True),
        sa.Column("file_gone_at", TIME, nullable=True),
        sa.CheckConstraint(
            "state IN ('received', 'inspecting', 'developing', 'selecting', 'estimating', "
            "'counted', 'stored', 'needs_lens', 'excluded', 'failed', 'cancelled')",
            name=op.f("ck_photo_state"),
        ),
        sa.ForeignKeyConstraint(["lens_id"], ["lens.id"], name=op.f("fk_photo_lens_id")),
        sa.ForeignKeyConstraint(["owner_id"], ["owner.id"], name=op.f("fk_photo_owner_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_photo")),
        sa.UniqueConstraint("public_id", name=op.f("uq_photo_public_id")),
    )
    op.create_index("ix_photo_lens_id_state", "photo", ["lens_id", "state"], unique=False)
    op.create_index("ix_photo_page", "photo", ["owner_id", "public_id"], unique=False)
    op.create_index("ix_photo_state", "photo", ["state"], unique=False)
    op.create_index(
        "uq_photo_bytes",
        "photo",
        ["owner_id", "sha256"],
        unique=True,
        sqlite_where=sa.text("deleted_at IS NULL"),
        postgresql_where=sa.text("deleted_at IS NULL"),
    )
    op.create_table(
        "session",
        sa.Column("token_hash", sa.String(length=64), nullable=False),
        sa.Column("key_id", sa.Integer(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("expires_at", TIME, nullable=False),
        sa.ForeignKeyConstraint(
            ["key_id"], ["api_key.id"], name=op.f("fk_session_key_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("token_hash", name=op.f("pk_session")),
    )
    op.create_index("ix_session_key_id", "session", ["key_id"], unique=False)
    op.create_table(
        "correction",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("public_id", sa.String(length=40), nullable=False),
        sa.Column("owner_id", sa.Integer(), nullable=False),
        sa.Column("photo_id", sa.Integer(), nullable=False),
        sa.Column("lens_id", sa.Integer(), nullable=False),
        sa.Column("lens_version", sa.Integer(), nullable=False),
        sa.Column("params", sa.JSON(), nullable=False),
        sa.Column("params_hash", sa.String(length=64), nullable=False),
        sa.Column("epoch", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=20), nullable=False),
        sa.Column("stage", sa.String(length=20), nullable=True),
        sa.Column("progress_done", sa.Integer(), nullable=False),
        sa.Column("progress_total", sa.Integer(), nullable=False),
        sa.Column("error_code", sa.String(length=40), nullable=True),
        sa.Column("error_detail", sa.Text(), nullable=True),
        sa.Column("report", sa.JSON(), nullable=True),
        sa.Column("result_key", sa.Text(), nullable=True),
        sa.Column("result_etag", sa.Text(), nullable=True),
        sa.Column("result_media_type", sa.Text(), nullable=True),
        sa.Column("result_bytes", sa.BigInteger(), nullable=True),
        sa.Column("result_name", sa.Text(), nullable=True),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("started_at", TIME, nullable=True),
        sa.Column("finished_at", TIME, nullable=True),
        sa.CheckConstraint(
            "state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')",
            name=op.f("ck_correction_state"),
        ),
        sa.ForeignKeyConstraint(["lens_id"], ["lens.id"], name=op.f("fk_correction_lens_id")),
        sa.ForeignKeyConstraint(["owner_id"], ["owner.id"], name=op.f("fk_correction_owner_id")),
        sa.ForeignKeyConstraint(
            ["photo_id"], ["photo.id"], name=op.f("fk_correction_photo_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_correction")),
        sa.UniqueConstraint("public_id", name=op.f("uq_correction_public_id")),
    )
    op.create_index("ix_correction_lens_id", "correction", ["lens_id"], unique=False)
    op.create_index("ix_correction_page", "correction", ["owner_id", "public_id"], unique=False)
    op.create_index("ix_correction_state", "correction", ["state"], unique=False)
    op.create_index(
        "uq_correction_params",
        "correction",
        ["photo_id", "lens_id", "lens_version", "params_hash"],
        unique=True,
        sqlite_where=sa.text("state NOT IN ('failed', 'cancelled')"),
        postgresql_where=sa.text("state NOT IN ('failed', 'cancelled')"),
    )
    op.create_table(
        "patch",
        sa.Column("id", KEY, nullable=False),
        sa.Column("photo_id", sa.Integer(), nullable=False),
        sa.Column("epoch", sa.Integer(), nullable=False),
        sa.Column("idx", sa.Integer(), nullable=False),
        sa.Column("cell", sa.Integer(), nullable=True),
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("size", sa.Integer(), nullable=False),
        sa.Column("r", sa.Double(), nullable=False),
        sa.Column("phi", sa.Double(), nullable=False),
        sa.Column("score", sa.Double(), nullable=True),
        sa.Column("state", sa.String(length=20), nullable=False),
        sa.Column("reason", sa.String(length=60), nullable=True),
        sa.Column("finished_at", TIME, nullable=True),
        sa.Column("encoded", sa.LargeBinary(), nullable=True),
        sa.CheckConstraint(
            "state IN ('pending', 'done', 'rejected', 'failed')",
            name=op.f("ck_patch_state"),
        ),
        sa.ForeignKeyConstraint(
            ["photo_id"], ["photo.id"], name=op.f("fk_patch_photo_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_patch")),
        sa.UniqueConstraint("photo_id", "epoch", "idx", name=op.f("uq_patch_photo_id_epoch_idx")),
    )
    op.create_table(
        "psf_sample",
        sa.Column("id", KEY, nullable=False),
        sa.Column("photo_id", sa.Integer(), nullable=False),
        sa.Column("patch_id", KEY, nullable=False),
        sa.Column("lens_id", sa.Integer(), nullable=True),
        sa.Column("version_added", sa.Integer(), nullable=True),
        sa.Column("channel", sa.String(length=1), nullable=False),
        sa.Column("r", sa.Double(), nullable=False),
        sa.Column("phi", sa.Double(), nullable=False),
        sa.Column("weight", sa.Double(), nullable=False),
        sa.Column("predicted_error", sa.Double(), nullable=True),
        sa.Column("size", sa.Integer(), nullable=False),
        sa.Column("format_version", sa.Integer(), nullable=False),
        sa.Column("crc32", sa.BigInteger(), nullable=False),
        sa.Column("psf", sa.LargeBinary(), nullable=False),
        sa.Column("estimator", sa.Text(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.ForeignKeyConstraint(["lens_id"], ["lens.id"], name=op.f("fk_psf_sample_lens_id")),
        sa.ForeignKeyConstraint(
            ["patch_id"], ["patch.id"], name=op.f("fk_psf_sample_patch_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["photo_id"], ["photo.id"], name=op.f("fk_psf_sample_photo_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_psf_sample")),
        sa.UniqueConstraint("patch_id", "channel", name=op.f("uq_psf_sample_patch_id_channel")),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_psf_sample_lens_version", "psf_sample", ["lens_id", "version_added", "id"], unique=False
    )
    op.create_index("ix_psf_sample_photo_id", "psf_sample", ["photo_id"], unique=False)
    # ### end Alembic commands ###


def downgrade() -> None:
    for table in (
        "psf_sample",
        "patch",
        "correction",
        "session",
        "photo",
        "calibration_event",
        "lens",
        "api_key",
        "worker",
        "owner",
        "blob_garbage",
    ):
        op.drop_table(table)
