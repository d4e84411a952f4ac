"""Types of the arrays that signatures name."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Complex = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
PadMasks = NDArray[np.uint32]
"""Per row, one bit for each pad."""
AnyArray = NDArray[Any]
