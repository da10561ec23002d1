"""Commands of the service, which `lensmodel` has where this package can be imported."""
