"""The laboratory: all that measures the library, compares it with others, and trains its data.

It may import everything; only the commands of `app/lab` import it.
"""
