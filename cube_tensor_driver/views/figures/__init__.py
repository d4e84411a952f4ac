# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures that commands write to files: functions that draw results as matplotlib figures."""
