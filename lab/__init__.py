"""The laboratory: all that measures the library, compares it with others, and trains its data."""
