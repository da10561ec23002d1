"""The command `lensmodel` on files: one module for each command or group, imported when it is called."""
