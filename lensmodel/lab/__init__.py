"""The laboratory: all that measures the library, compares it with others, and trains its data.

It may import everything; nothing outside imports it.
"""
