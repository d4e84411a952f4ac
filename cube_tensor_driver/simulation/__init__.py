"""Simulation of hubs: loads, pads, hubs, lines and faults.

A simulated skin is a source of frequencies in this process (`source`), or a process of its own with
ports (`main`). A log tells what the hubs sampled, to compare it with what arrived. ROS is not
imported.
"""
