# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The list of processes that a skin needs, and the code that starts, watches and ends them.

Nothing in this folder imports ROS: nodes are started as commands. The nodes are in ros/nodes/.
"""
