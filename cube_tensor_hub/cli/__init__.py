"""The commands check and firmware."""
