"""What the power spectra of patches say: the scene's prior, and kernels and wavefronts under it."""
