"""Durable work: what must be done, by whom, in which child process, and how it ends."""
