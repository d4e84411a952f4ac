# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Samples of all links are counted here and joined into scans (one sample of every cube)."""
