# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of touches, made in the same way by the node `reconstruction` and by reprocessing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .sequences import encode_header, encode_sequences

if TYPE_CHECKING:
    from ..touch.touch_detection import Touches


def encode_touch(frame_id: str, touches: Touches) -> bytes:
    """Return a serialised SkinTouch message.

    Args:
        frame_id: Parent frame of the skin.
        touches: Touches of one scan.
    """
    shear_x, shear_y, along_z = touches.force.T
    shear_x_uncertainty, shear_y_uncertainty, force_uncertainty = touches.force_uncertainty.T
    numbers = (
        touches.pressure,
        touches.pressure_uncertainty,
        -along_z,
        force_uncertainty,
        shear_x,
        shear_y,
        shear_x_uncertainty,
        shear_y_uncertainty,
    )
    columns = (
        touches.cube.astype(np.uint16),
        touches.id.astype(np.int64),
        *(column.astype(np.float32) for column in numbers),
    )
    return encode_sequences(encode_header(touches.stamp_ns, frame_id), columns)
