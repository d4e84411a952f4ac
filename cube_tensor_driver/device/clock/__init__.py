"""The clock of a hub, mapped to the clock of the host."""
