"""Tables and progress in the terminal: rich and nothing else draws here."""
