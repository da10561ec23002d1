"""The laboratory: all that measures the library, compares it with others, and trains its data.

It may import everything, and nothing imports it but `lensmodel bench` and `lensmodel reproduce`.
"""
