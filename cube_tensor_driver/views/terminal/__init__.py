"""Output of commands to a terminal: progress, tables, the live table of a skin; and Ctrl-C."""
