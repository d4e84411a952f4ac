# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The physics: from pad frequencies to stress and its gradient, and what is measured to get there.

The folder needs numpy, and transforms3d for rotations. It has no input or output, no clock, no
threads and no ROS. Data leave it as `FrequencyRows` and `StressRows`; `Reconstructor` computes the
second from the first.
"""
