"""Around every request, and between routes and the rest: bodies, errors, uploads, answers."""
