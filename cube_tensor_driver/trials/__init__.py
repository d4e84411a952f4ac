"""Whole skins in real processes, measured against what was sent: demo, torture, bench."""
