"""How Alembic reaches the database: through a connection that the caller has opened."""

from __future__ import annotations

from alembic import context

from app.store.tables import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_as_batch=True,  # SQLite cannot alter tables, only copy them
    transactional_ddl=True,
    compare_type=True,
)
context.run_migrations()
