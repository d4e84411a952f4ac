# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Runs driver and reconstruction in one process, which saves sending frequencies over DDS.

The topic `frequencies` is published only while it has subscribers.
"""

from __future__ import annotations

from ..node import CubeNode, run
from .driver import Driver
from .reconstruction import Reconstruction


def make_nodes() -> list[CubeNode]:
    """Make the nodes `driver` and `reconstruction`.

    The driver passes its frequencies to the reconstruction by a function call.
    """
    reconstruction = Reconstruction(subscribes=False)
    return [reconstruction, Driver(reconstruction.on_rows)]


def main() -> None:
    """Run driver and reconstruction in one process."""
    run(make_nodes)


if __name__ == "__main__":
    main()
