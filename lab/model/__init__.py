"""How well a model predicts the PSF where no sample was."""
