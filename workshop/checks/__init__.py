# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a torture: what a skin published, compared with what its simulated hubs did.

One comparison per file; `all_checks.py` puts them together. What was sent comes from the sample log
of the simulator, what arrived from a record of both topics. What the driver counts is a statement
that is checked, too. Nothing here imports ROS.
"""
