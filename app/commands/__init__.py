"""The subcommands of `lensmodel`, one module for each group."""
