"""Contacts followed from scan to scan, each a loaded disc fitted to the stress of the cubes."""
