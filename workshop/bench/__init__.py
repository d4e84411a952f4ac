# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Speed of the driver, as a ratio to a floor that is measured in the same run."""
