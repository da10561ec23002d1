"""Steps from each schema to the next; `app.store.upkeep.migrate` runs them."""
