"""A node with a mutation: `python -m workshop.torture.mutated_node NAME --ros-args …`."""

from __future__ import annotations

import sys
from importlib import import_module

from .mutations import MUTATIONS


def main() -> None:
    """Patch this process, then run the node as usual."""
    mutation = MUTATIONS[sys.argv.pop(1)]
    mutation.patch()
    import_module(f"cube_tensor_driver.ros.nodes.{mutation.node}").main()


if __name__ == "__main__":
    main()
