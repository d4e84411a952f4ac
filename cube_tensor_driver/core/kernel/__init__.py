# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The kernel: one pass over the rows of a scan, in C where it is compiled, else in numpy."""
