"""What a patch says without a kernel: its spectrum.

Revision: 0002, after 0001
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("psf_sample", sa.Column("spectrum", sa.LargeBinary(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("psf_sample", schema=None) as batch_op:
        batch_op.drop_column("spectrum")
