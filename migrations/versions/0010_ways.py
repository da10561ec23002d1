"""Each lens is learned in a way of its own, and may change it: photos are estimated anew beside what counts.

Revision: 0010, after 0009
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

OLD_KINDS = ("photo_added", "photo_included", "photo_excluded", "photo_removed", "photo_changed")
ADDED = {"calibration_event": ["way"], "photo": ["way", "relearning"], "lens": ["way", "answering_way"]}
KIND = "ck_calibration_event_kind"


def _way(name: str) -> sa.Column[str]:
    return sa.Column(name, sa.String(length=20), server_default="default", nullable=False)


def _allow(kinds: tuple[str, ...]) -> None:
    """Put another check in the place of that of the kinds of events."""
    connection = op.get_bind()
    read = sa.Table("calibration_event", sa.MetaData(), autoload_with=connection)
    copied = any(isinstance(one, sa.CheckConstraint) for one in read.constraints)  # SQLAlchemy 2.0 reads none
    with op.batch_alter_table("calibration_event", schema=None) as batch_op:
        if copied or connection.dialect.name != "sqlite":
            batch_op.drop_constraint(op.f(KIND), type_="check")
        batch_op.create_check_constraint(op.f(KIND), f"kind IN ({', '.join(repr(kind) for kind in kinds)})")


def upgrade() -> None:
    op.add_column("lens", _way("way"))
    op.add_column("lens", _way("answering_way"))
    op.add_column("photo", _way("way"))
    op.add_column("photo", sa.Column("relearning", sa.Boolean(), server_default=sa.false(), nullable=False))
    op.add_column("calibration_event", _way("way"))
    _allow((*OLD_KINDS, "model_changed"))


def downgrade() -> None:
    # an older program knows such a version as one whose photos changed
    op.execute("UPDATE calibration_event SET kind = 'photo_changed' WHERE kind = 'model_changed'")
    _allow(OLD_KINDS)
    for table, columns in ADDED.items():
        with op.batch_alter_table(table, schema=None) as batch_op:
            for column in columns:
                batch_op.drop_column(column)
