"""What every part of the library shares: values, errors, geometry, kernels, files.

There are more than fifteen modules because each is one concept that rooms need which do not know each other.
"""
