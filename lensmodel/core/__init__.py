"""What every part of the library shares: values, errors, geometry, kernels, files, processes."""
