"""Rows of owners, keys and sessions."""
