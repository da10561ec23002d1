"""Bounds on what a correction may do."""
