"""What a photo file says before a pixel is decoded: kind, size, directories of tags."""
