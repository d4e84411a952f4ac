# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The demo: it runs a simulated skin in real processes and checks the tensors that arrive.

`demo` starts the processes, and `watching` shows and collects the tensors. `verification` compares
them with the samples that the simulated hubs sent, `load_verification` with the simulated load.
"""
