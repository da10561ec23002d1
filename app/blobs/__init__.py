"""Files beside the tables: photos, previews, results; all of an owner, to take away or to erase."""
