"""lensmodel."""
