# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings (bags): rosbag2's files are read, written and repaired here without ROS or rosbag2."""
