# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Device times (of the clock of a hub) are converted to host times here."""
