"""A population of lenses, scenes and cameras whose truth is known, and the network that is trained on it."""
