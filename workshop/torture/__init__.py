"""A skin in real processes under all faults, checked against the simulator's log."""
