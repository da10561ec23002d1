"""Samples keep how dark their photo gets around them, which bounds the light that a lens throws far.

Revision: 0011, after 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("psf_sample", sa.Column("darkest", sa.Double(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("psf_sample", schema=None) as batch_op:
        batch_op.drop_column("darkest")
