# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Driver for the cubic stress tensor sensor: pad frequencies in, stress tensors and gradients out.

    import cube_tensor_driver as ctd

    skin = ctd.read_skin("skin.yaml")
    reconstruct = ctd.Reconstructor(skin)
    with ctd.open_links(skin) as source:  # or ctd.open_bag("bag"), ctd.simulate(skin)
        for rows in source:
            print(reconstruct(rows).stress[:, 2])

Sources yield `FrequencyRows`, and a `Reconstructor` computes `StressRows` from them, which
publishers, bags and plots take. docs/python.md continues from here.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .bags.reprocess.table import read_frequency_table, reprocess_table
    from .bags.source import open_bag
    from .config.skin import read_skin
    from .core.errors import CubeError
    from .core.forces import Forces
    from .core.reconstructor import Reconstructor
    from .core.rows import FrequencyRows, StressRows
    from .device.live import open_links
    from .simulation.source import simulate
    from .touch.inverse import SurfaceInverse
    from .touch.touch_detection import Touch

__all__ = [
    "CubeError",
    "Forces",
    "FrequencyRows",
    "Reconstructor",
    "StressRows",
    "SurfaceInverse",
    "Touch",
    "open_bag",
    "open_links",
    "read_frequency_table",
    "read_skin",
    "reprocess_table",
    "simulate",
]

# ROS installs the generated messages as a package of the same name in another place, and this path
# makes one package of both.
__path__ = pkgutil.extend_path(__path__, __name__)

_HOMES = {
    "CubeError": ".core.errors",
    "Forces": ".core.forces",
    "FrequencyRows": ".core.rows",
    "Reconstructor": ".core.reconstructor",
    "StressRows": ".core.rows",
    "SurfaceInverse": ".touch.inverse",
    "Touch": ".touch.touch_detection",
    "read_frequency_table": ".bags.reprocess.table",
    "open_bag": ".bags.source",
    "open_links": ".device.live",
    "read_skin": ".config.skin",
    "reprocess_table": ".bags.reprocess.table",
    "simulate": ".simulation.source",
}
"""Module of each public name.

It is imported when the name is first used, because a node needs no bags and a notebook no ports.
"""


def __getattr__(name: str) -> object:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(_HOMES[name], __name__), name)
    except ModuleNotFoundError as error:
        from .core.errors import CubeError

        raise CubeError(
            f"{name} needs the Python package {error.name}: pip install 'cube_tensor_driver[bags]'"
        ) from None


def __dir__() -> list[str]:
    """List the public names also before they are imported, for completion in a notebook."""
    return sorted([*globals(), *__all__])
