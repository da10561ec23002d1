"""What made the data files that the library ships."""
