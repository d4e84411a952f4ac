"""Makes the statuses that the nodes publish on /diagnostics."""
