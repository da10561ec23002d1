"""Patches keep what they say without a kernel; samples no longer spectra, bounds of far light and statistics.

Samples of before mean nothing to the model any more: reading them asks for a calibration.

Revision: 0012, after 0011
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("patch", sa.Column("encoded", sa.LargeBinary(), nullable=True))
    with op.batch_alter_table("psf_sample", schema=None) as batch_op:
        for name in ("spectrum", "darkest", "statistics_key"):
            batch_op.drop_column(name)


def downgrade() -> None:
    with op.batch_alter_table("psf_sample", schema=None) as batch_op:
        batch_op.add_column(sa.Column("spectrum", sa.LargeBinary(), nullable=True))
        batch_op.add_column(sa.Column("darkest", sa.Double(), nullable=True))
        batch_op.add_column(sa.Column("statistics_key", sa.Text(), nullable=True))
    with op.batch_alter_table("patch", schema=None) as batch_op:
        batch_op.drop_column("encoded")
