"""The laboratory's commands, and measurements of the service; only `app.cli` imports it, to mount them."""
