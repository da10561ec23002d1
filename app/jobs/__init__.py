"""Durable jobs: the queue, the workers that run them, and their tasks in child processes."""
