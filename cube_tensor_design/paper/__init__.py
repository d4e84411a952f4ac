# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The source paper's experiments on a virtual bench: plates, rods, large deformation."""
