"""What HTTP needs besides the routes: middleware, bodies, errors, uploads, formats of answers."""
