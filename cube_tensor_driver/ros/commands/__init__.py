# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Functions of the commands that need ROS: record, replay, echo, list topics, call services."""
