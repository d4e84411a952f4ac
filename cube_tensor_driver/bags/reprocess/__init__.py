# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reprocessing of bags: stress and contacts are computed again from recorded frequencies."""
