"""The nodes, one per file, and what only nodes publish."""
