# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""python -m counted_node FILE MODULE [ARGUMENT ...]: runs a module that tells its objects.

At each signal SIGUSR1 it writes to the file how many objects of each type it has.
"""

from __future__ import annotations

import gc
import json
import runpy
import signal
import sys
from collections import Counter
from pathlib import Path


def count_objects() -> Counter[str]:
    """Count the objects of this process by their type."""
    gc.unfreeze()
    gc.collect()
    tracked = gc.get_objects()
    # The garbage collector knows objects such as `bytes` only by the objects that hold them.
    objects = {id(one): one for one in tracked}
    objects |= {id(one): one for one in gc.get_referents(*tracked)}
    return Counter(type(one).__name__ for one in objects.values())


if __name__ == "__main__":
    _, path, module, *arguments = sys.argv

    def write_counts(*_: object) -> None:
        partial = Path(path).with_suffix(".partial")
        partial.write_text(json.dumps(count_objects()))
        partial.rename(path)

    signal.signal(signal.SIGUSR1, write_counts)
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__")
