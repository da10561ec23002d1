"""Upkeep of the tables: migrations, invariants, transfer, an operator's queries."""
