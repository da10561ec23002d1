"""Types of columns that no database has by itself."""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import BigInteger, DateTime, Dialect, Integer, TypeDecorator


class UtcTime(TypeDecorator[datetime]):
    """Points in time: aware in Python, UTC in the table, also where SQL knows no zones."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Bring to UTC; naive times are a programming error."""
        del dialect
        if value is not None and value.tzinfo is None:
            raise ValueError(f"time without a zone: {value}")
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Give back with the zone that SQLite forgets."""
        del dialect
        return value.replace(tzinfo=UTC) if value is not None and value.tzinfo is None else value


BigKey = BigInteger().with_variant(Integer, "sqlite")  # SQLite counts rows only in INTEGER keys
