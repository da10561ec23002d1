"""How far an answer can be trusted: what stands behind it, and what the patches say of it."""
