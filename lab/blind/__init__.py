"""How near blind estimates come to the truth."""
