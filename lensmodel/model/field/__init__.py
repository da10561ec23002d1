"""The PSF as a regression over samples: neighbours of a question, turned into its frame, and weighed."""
