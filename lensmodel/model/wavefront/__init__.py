"""The PSF as one wavefront for the whole lens, fitted to the kernels or the spectra of all samples."""
