"""The service: HTTP, rows, blobs and background jobs around the library `lensmodel`."""
