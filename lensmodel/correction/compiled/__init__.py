"""Compiled loops that several modules share, or that are as long as a method."""
