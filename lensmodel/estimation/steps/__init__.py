"""Steps that several blind estimators share."""
