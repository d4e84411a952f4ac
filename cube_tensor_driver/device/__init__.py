# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""From the bytes of hubs to `FrequencyRows`: protocol, links, clocks, counting, scans.

A hub is the microcontroller that samples one or more cubes and sends its samples over one link (a
serial port or TCP). The live source (`open_links`) joins all steps. This folder does not import
ROS, and it does not interpret the frequencies.
"""
