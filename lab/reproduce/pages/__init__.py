"""The page of a reproduction: its tables, figures and bars."""
