"""The demo: a simulated skin in real processes, measured against what was sent."""
