# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contact tracker: follows contacts from scan to scan as Hertz contacts fitted to all cubes."""
