# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The commands fem, study and paper: one file each, with arguments, work and display."""
