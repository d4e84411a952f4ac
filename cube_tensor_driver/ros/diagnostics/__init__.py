"""What nodes report on /diagnostics."""
