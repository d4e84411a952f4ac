"""Hubs that exist only in software: loads, pads, hubs, lines, faults, and the log of what they sent.

Verification against that log is here too. ROS is not imported.
"""
