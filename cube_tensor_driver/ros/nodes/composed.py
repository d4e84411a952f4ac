"""Driver and reconstruction in one process: the rows of the driver do not travel over DDS.

`frequencies` is published only while somebody subscribes to it.
"""

from __future__ import annotations

from ..node import CubeNode, run
from .driver import Driver
from .reconstruction import Reconstruction


def make_nodes() -> list[CubeNode]:
    """Make both nodes; the driver calls the reconstruction with its rows."""
    reconstruction = Reconstruction(subscribes=False)
    return [reconstruction, Driver(reconstruction.on_rows)]


def main() -> None:
    run(make_nodes)


if __name__ == "__main__":
    main()
