"""One file for each resource; a route turns a question into a library or store call, and back."""
