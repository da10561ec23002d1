"""What keeps the tables sound: migrations, invariants, transfer, an operator's questions."""
