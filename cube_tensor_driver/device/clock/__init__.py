"""Device times (of the clock of a hub) are converted to host times here."""
