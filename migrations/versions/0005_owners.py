"""Keys of owners, signed-in browsers, answers by idempotency key; photos whose file is gone.

Revision: 0005, after 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.add_column("owner", sa.Column("quota_bytes", sa.BigInteger(), nullable=True))
    op.add_column("owner", sa.Column("quota_photos", sa.Integer(), nullable=True))
    op.add_column("owner", sa.Column("erased_at", TIME, nullable=True))
    op.add_column("photo", sa.Column("location", sa.String(length=10), nullable=True))
    op.add_column("photo", sa.Column("file_gone_at", TIME, nullable=True))
    op.add_column("photo", sa.Column("file_sha256", sa.String(length=64), nullable=True))
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
        sa.UniqueConstraint("prefix", name=op.f("uq_api_key_prefix")),
        sa.UniqueConstraint("key_hash", name=op.f("uq_api_key_key_hash")),
    )
    op.create_index("ix_api_key_owner_id", "api_key", ["owner_id"])
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
    op.create_index("ix_session_key_id", "session", ["key_id"])


def downgrade() -> None:
    op.drop_table("session")
    op.drop_table("api_key")
    with op.batch_alter_table("photo", schema=None) as batch_op:
        batch_op.drop_column("file_gone_at")
        batch_op.drop_column("file_sha256")
        batch_op.drop_column("location")
    with op.batch_alter_table("owner", schema=None) as batch_op:
        batch_op.drop_column("erased_at")
        batch_op.drop_column("quota_photos")
        batch_op.drop_column("quota_bytes")
