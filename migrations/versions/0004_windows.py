"""Rejected windows are a map of the photo, no rows; deleted photos keep no hash.

Revision: 0004, after 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("photo", sa.Column("windows_rejected", sa.Integer(), nullable=False, server_default="0"))
    op.add_column("photo", sa.Column("windows", sa.JSON(), nullable=True))
    op.execute("UPDATE photo SET sha256 = '' WHERE deleted_at IS NOT NULL")


def downgrade() -> None:
    with op.batch_alter_table("photo", schema=None) as batch_op:
        batch_op.drop_column("windows")
        batch_op.drop_column("windows_rejected")
