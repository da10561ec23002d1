"""Steps that the blind methods of others share: from coarse to fine, gradients, kernels."""
