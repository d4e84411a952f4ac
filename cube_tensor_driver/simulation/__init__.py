"""Hubs that exist only in software: loads, pads, hubs, lines and faults.

Also here is the log of what these hubs sampled, and what compares it with what arrived. A simulated
skin is a source of frequencies in this process (`source`), or a process with ports (`main`). ROS is
not imported.
"""
