"""The whole chain: photos in, corrected photos out, against the truth."""
