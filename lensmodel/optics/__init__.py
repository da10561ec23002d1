"""Optics of the fit: from aberrations to a wavefront, from a wavefront to kernels and transfer functions.

The simulator has optics of its own (`lensmodel.simulate`): a truth must not share code with what it judges.
"""
