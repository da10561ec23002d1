"""Lenses know their kind by a key: whose other copies a question leans on is found by an index.

Revision: 0009, after 0008
"""

from __future__ import annotations

import re

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def _kind(maker: str | None, model: str) -> str:
    # as the service makes it from this revision on; spelled out, so that the step stays what it was
    return "|".join(re.sub(r"[\W_]+", "", (name or "").casefold()) for name in (maker, model))


def upgrade() -> None:
    op.add_column("lens", sa.Column("kind_key", sa.Text(), nullable=True))
    lens = sa.table("lens", sa.column("maker"), sa.column("model"), sa.column("kind_key"))
    connection = op.get_bind()
    kinds = connection.execute(
        sa.select(lens.c.maker, lens.c.model).where(lens.c.model.is_not(None)).distinct()
    )
    for maker, model in kinds.all():
        same_maker = lens.c.maker.is_(None) if maker is None else lens.c.maker == maker
        connection.execute(
            lens.update().where(same_maker, lens.c.model == model).values(kind_key=_kind(maker, model))
        )
    op.create_index("ix_lens_kind", "lens", ["owner_id", "kind_key", "public_id"])
    op.create_index("ix_lens_page", "lens", ["owner_id", "public_id"])


def downgrade() -> None:
    op.drop_index("ix_lens_page", "lens")
    op.drop_index("ix_lens_kind", "lens")
    with op.batch_alter_table("lens", schema=None) as batch_op:
        batch_op.drop_column("kind_key")
