# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Export of bags to a LeRobot data set (LeRobotDataset v3.0: Parquet files and metadata for robot
learning).

The stress comes from `bags.reprocess`; this package arranges it in frames and episodes. Neither ROS
nor the package `lerobot` is imported.
"""
