# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Files that people write and the program checks: skins, calibrations, tares, load scripts.

A file is checked completely before any link is opened or any node starts, and each mistake is
reported with the name of the file and the key. Recordings are not here but in bags/. The parameters
of the ROS nodes are here too, because commands that run without ROS take them as options.
"""
