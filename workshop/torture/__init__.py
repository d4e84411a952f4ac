# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A skin in real processes under all faults, checked against the simulator's log."""
