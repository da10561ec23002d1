"""Steps from each schema to the next; `app.store.database` runs them."""
