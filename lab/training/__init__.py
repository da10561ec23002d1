"""What made the patch selector that the library ships, and the data of the laboratory."""
