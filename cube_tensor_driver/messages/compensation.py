# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Encoding and decoding of SkinCompensation messages: the motion of a skin, for the compensation of
its weight, and the states of creep and temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import Array
from ..core.compensation.motion import UNKNOWN_MOTION, Motion
from ..core.errors import MessageError
from .sequences import encode_header, encode_sequences

if TYPE_CHECKING:
    from ..msg import SkinCompensation

STATES = ("creep", "thermal")
"""Names of those fields of SkinCompensation.msg that contain the state of a compensated effect
(viscoelastic creep; temperature of the elastomer)."""


NO_STATE = np.zeros(0)
"""Empty array in place of the state of an effect (creep or temperature), if the effect is not
compensated or the message does not contain the state. With the state, which sums up all earlier
rows, reprocessing can continue the compensation in the middle of a recording."""


def encode_compensation(
    frame_id: str,
    stamp_ns: int,
    motion: Motion | None,
    states: Mapping[str, Array],
) -> bytes:
    """Return a serialised SkinCompensation, with which reprocessing can repeat the compensation.

    Args:
        frame_id: Parent frame of the skin.
        stamp_ns: Stamp of the messages of frequencies and stress to which the message belongs, in
            ns since the Unix epoch.
        motion: Motion of the skin; None: weight is not compensated.
        states: Name of a compensated effect, one of `STATES` -> its state, as
            `Compensation.collect_states` returns it.
    """
    time_ns, state = motion or UNKNOWN_MOTION
    begin = encode_header(stamp_ns, frame_id) + bytes([motion is not None])
    effects = [states.get(name, NO_STATE) for name in STATES]
    columns = time_ns - stamp_ns, state[:, 0].ravel(), state[:, 1:].ravel(), *effects
    return encode_sequences(begin, columns)


def read_motion(message: SkinCompensation, stamp_ns: int) -> Motion | None:
    """Return the motion (specific force and its gradient over time) in a SkinCompensation message.

    The result is None if the weight of the elastomer is not compensated.

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
        parts = force.reshape(n, 1, 3), gradient.reshape(n, 3, 3)
    except ValueError:
        raise MessageError(
            f"compensation: {len(offsets)} instants with {len(message.specific_force)} numbers of "
            f"specific force and {len(message.gradient)} of its gradient; 3 and 9 each are needed"
        ) from None
    return Motion(stamp_ns + offsets, np.concatenate(parts, axis=1))


def read_states(message: SkinCompensation) -> dict[str, Array]:
    """Return the states of creep and temperature in a SkinCompensation, by their names in `STATES`.

    States that are empty in the message are left out.
    """
    states = {}
    for name in STATES:
        state = np.asarray(getattr(message, name), float)
        if len(state):
            states[name] = state
    return states
