"""What commands show in a terminal: tables of results, progress, the live table of a skin."""
