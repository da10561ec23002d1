"""Files beside the tables: photos, previews, results; export and erasure of an owner."""
