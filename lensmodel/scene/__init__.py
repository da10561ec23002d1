"""What is known of scenes before one is seen, so that the rest of a photo's spectrum is the lens's."""
