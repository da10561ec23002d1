"""The first schema: empty databases get the newest one at once, see `app.store.database.upgrade`.

Revision: 0001, the first
"""

from __future__ import annotations

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    pass


def downgrade() -> None:
    pass
