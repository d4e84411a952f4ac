# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of SkinCompensation: motion of the skin, and states of effects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import Array
from ..core.compensation.motion import Motion
from ..core.errors import MessageError

if TYPE_CHECKING:
    from ..msg import SkinCompensation

STATES = ("creep", "thermal")
"""Names of those fields of SkinCompensation.msg that contain the state of a compensated effect
(viscoelastic creep; temperature of the elastomer)."""


def read_motion(message: SkinCompensation, stamp_ns: int) -> Motion | None:
    """Return the specific force over time that a SkinCompensation message contains.

    It is None if the weight of the elastomer is not compensated.

    Args:
        message: The message.
        stamp_ns: Stamp of its header, in ns since the Unix epoch.

    Raises:
        MessageError: The lengths of its arrays contradict each other.
    """
    if not message.weight:
        return None
    offsets = np.asarray(message.time_offset, np.int64)
    n = len(offsets)
    force = np.asarray(message.specific_force, float)
    gradient = np.asarray(message.gradient, float)
    try:
        return Motion(
            stamp_ns + offsets,
            force.reshape(n, 3),
            gradient.reshape(n, 3, 3),
        )
    except ValueError:
        raise MessageError(
            f"compensation: {len(offsets)} instants with {len(message.specific_force)} numbers of "
            f"specific force and {len(message.gradient)} of its gradient; 3 and 9 each are needed"
        ) from None


def read_states(message: SkinCompensation) -> dict[str, Array]:
    """Return the states of effects in a SkinCompensation message, by their names in `STATES`.

    States that are empty in the message are left out.
    """
    states = {}
    for name in STATES:
        state = np.asarray(getattr(message, name), float)
        if len(state):
            states[name] = state
    return states
