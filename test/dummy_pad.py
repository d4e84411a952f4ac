# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A cube with a dummy pad, which no load reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cube_tensor_driver.core.calibration import Calibration, make_illustrative_calibration
from cube_tensor_driver.core.layout import Layout


def with_dummy(layout_name: str, **changes) -> Calibration:
    """The illustrative calibration with one pad more, the last one."""
    plain = make_illustrative_calibration(layout_name)
    own = plain.layout
    positions, normals = (np.vstack([rows, np.zeros(3)]) for rows in (own.positions, own.normals))
    one_more = {
        name: getattr(plain, name)[0] for name in ("rest_frequency", "noise", "modulus", "beta")
    }
    layout = Layout("with_dummy", positions, normals, own.pad_size)
    return replace(plain, layout=layout, gain=np.array(1.0), **one_more, **changes)
