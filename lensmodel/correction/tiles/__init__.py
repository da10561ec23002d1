"""A photo in tiles: their lattice, the canvas of the transforms, and what surrounds each."""
