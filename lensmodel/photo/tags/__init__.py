"""What a photo file says about camera, lens, exposure and place."""
