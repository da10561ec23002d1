"""`lensmodel demo`: the whole way once, on a real RAW file and on a lens whose truth is known."""
