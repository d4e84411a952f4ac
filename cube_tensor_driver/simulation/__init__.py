# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulation of a skin: loads on it, pads of its cubes, hubs, lines to the host, and faults.

A simulated skin is either a source of frequencies in this process (`source`), or a process of its
own whose hubs are on serial ports or TCP (`main`). Such a process writes a log of the samples that
its hubs took, to compare them with those that arrived. ROS is not imported.
"""
