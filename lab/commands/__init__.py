"""The laboratory's commands: `lensmodel bench` and `lensmodel reproduce`, which exist in the source tree."""
