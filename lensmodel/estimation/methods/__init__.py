"""The blind estimators, one a file; `lensmodel.estimation.estimators` has them by name."""
