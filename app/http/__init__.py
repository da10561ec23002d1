"""What HTTP needs besides the routes: middleware, bodies, errors, uploads."""
