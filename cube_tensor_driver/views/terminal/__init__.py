# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Output of commands to a terminal: progress, tables, the live table of a skin; and Ctrl-C."""
