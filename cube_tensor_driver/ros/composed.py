"""Driver and reconstruction in one process: tensors without the hop over DDS. `frequencies` is sent
to who listens."""

from __future__ import annotations

from .driver import Driver
from .node import CubeNode, run
from .reconstruction import Reconstruction


def nodes() -> list[CubeNode]:
    """Both nodes, the driver handing its rows over."""
    reconstruction = Reconstruction(subscribes=False)
    return [reconstruction, Driver(reconstruction.take_rows)]


def main() -> None:
    run(nodes)


if __name__ == "__main__":
    main()
