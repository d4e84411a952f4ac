# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Display of results: the scene of a skin, pictures, and the output of commands to a terminal.

`scene` computes the colours and lines that RViz and the browser view draw.
"""
