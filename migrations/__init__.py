"""Steps from each schema to the next; `app.store.migrate` runs them."""
