# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of touches, made in the same way by the node `reconstruction` and by reprocessing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .point_cloud import MakeMessage, make_header
from .types import TOUCH

if TYPE_CHECKING:
    from ..touch.touch_detection import Touches


def make_touch_message(
    make: MakeMessage,
    frame_id: str,
    touches: Touches,
) -> object:
    """Make a SkinTouch message.

    Args:
        make: Function that constructs a message from its type's name and its fields.
        frame_id: Parent frame of the skin.
        touches: Touches of one scan.
    """
    shear_x, shear_y, along_z = touches.force.T
    shear_x_uncertainty, shear_y_uncertainty, force_uncertainty = touches.force_uncertainty.T
    columns = {
        "pressure": touches.pressure,
        "pressure_uncertainty": touches.pressure_uncertainty,
        "normal_force": -along_z,
        "force_uncertainty": force_uncertainty,
        "shear_x": shear_x,
        "shear_y": shear_y,
        "shear_x_uncertainty": shear_x_uncertainty,
        "shear_y_uncertainty": shear_y_uncertainty,
    }
    return make(
        TOUCH,
        header=make_header(make, touches.stamp_ns, frame_id),
        cube=touches.cube.astype(np.uint16),
        id=touches.id,
        **{name: column.astype(np.float32) for name, column in columns.items()},
    )
