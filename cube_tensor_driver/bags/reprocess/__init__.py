"""Stress and contacts computed again from the recorded frequencies of bags."""
