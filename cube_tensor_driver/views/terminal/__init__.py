"""What several commands show in a terminal: progress, tables, the live table of a skin, Ctrl-C."""
