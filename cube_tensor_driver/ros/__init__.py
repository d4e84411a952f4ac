# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""ROS nodes and messages: the only folder that publishes, subscribes or offers services.

The nodes contain only parameters, topics and services; the computations are in `core`, `device` and
`bags`.
"""
