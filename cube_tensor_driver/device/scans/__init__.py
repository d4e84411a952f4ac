"""Samples of all links are counted here and joined into scans (one sample of every cube)."""
