# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The numbered rules of docs/protocol.md, one function each; a module has those of one section.

The function of a rule looks at the steps of a conversation (`conversation.py`) and returns what
came. A function does not check what another rule is about, so that a hub which breaks one rule
fails one.
"""

from . import frames, hello, line, request, sample, time

__all__ = ["frames", "hello", "line", "request", "sample", "time"]
