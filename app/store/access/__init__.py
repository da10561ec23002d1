"""Rows of owners, keys, sessions and answers that were given already."""
