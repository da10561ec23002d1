"""The subcommands of `lensmodel`, one module for each group.

There are more than fifteen modules because each is imported only when one of its commands is called.
"""
