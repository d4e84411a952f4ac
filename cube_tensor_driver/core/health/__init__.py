# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Health of the pads, and their rest frequencies: statistics, diagnosis, tare and drift."""
