# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Makes the statuses that the nodes publish on /diagnostics."""
