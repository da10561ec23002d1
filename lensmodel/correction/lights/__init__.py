"""Clipped light: how much of it there was, and what it does to its surroundings."""
