# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Serial ports and TCP connections are opened and read here, and the hub behind each is started."""
