"""Accuracy benchmarks that a user can run too."""
