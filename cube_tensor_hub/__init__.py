# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""For people who build hubs: a check of docs/protocol.md, and hubs in C as examples.

    wire ── bytes ── decoder ── frames ── Conversation ── Transcript ── rules ── results

Only `PortWire` has input, output and a clock. ROS is not imported.
"""
