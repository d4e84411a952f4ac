"""Studies: where each layout and each field can be trusted."""
