"""The deconvolution methods, one a file; `lensmodel.correction.deconvolvers` has them by name."""
