# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What only developers of the package run: torture, mutations, benchmarks, pictures, lint and docs.

It is part of the repository and never installed.
"""
