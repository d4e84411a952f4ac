# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Status bits of rows and conditions of pads, with the values that SkinStress.msg states."""

from __future__ import annotations

PAD_FAULT = 1
"""Status bit: at least one pad of the cube was not used for this row (sample of one cube).

The device reports a fault of the pad, the frequency of the pad is impossible, or the diagnosis of
the pads found it stuck or noisy.
"""

RESIDUAL = 2
"""Status bit: the residual is above its limit.

The residual measures how far the signals of a cube's pads contradict each other. Noise alone
exceeds the limit in one row (sample of a cube) of a thousand. If many rows exceed it, the load
causes a stress field that the reconstruction cannot express, or a pad is broken.
"""

INVALID = 4
"""Status bit: no component of stress or gradient was recovered, so all of them are NaN."""

TEMPERATURE = 8
"""Status bit: the calibration corrects for temperature, but the temperature is unknown.

The reference temperature of the calibration was assumed instead.
"""

STAMP = 2048
"""Status bit: the time stamp is doubtful.

The clock of the device seems to have been set, or the time that the device sends does not advance
like a clock.
"""

COMPENSATION = 4096
"""Status bit: a compensation that is asked for is missing, stale or uncertain.

Weight, creep or temperature was not subtracted from the stresses on the pads, because the rows or
the calibration lack the data for it, or the compensation is more uncertain than usual.
"""

WEIGHT = 8192
"""Status bit: weight and inertia of the cube and of the elastomer around it are subtracted."""

CREEP = 16384
"""Status bit: the creep of the elastomer (strain that follows a load slowly) is subtracted."""

THERMAL = 32768
"""Status bit: thermal stress and thermal drift of the pads are subtracted."""

STATUS = {
    "PAD_FAULT": PAD_FAULT,
    "RESIDUAL": RESIDUAL,
    "INVALID": INVALID,
    "TEMPERATURE": TEMPERATURE,
    "STAMP": STAMP,
    "COMPENSATION": COMPENSATION,
    "WEIGHT": WEIGHT,
    "CREEP": CREEP,
    "THERMAL": THERMAL,
}
"""Status bits by name, as messages and tables show them."""

OPEN = 16
"""Condition of a pad: its frequency is so high that the capacitor must be disconnected."""
SHORT = 32
"""Condition of a pad: no frequency is measured (0 or NaN), as with a short circuit."""
RANGE = 64
"""Condition of a pad: by the pad law (frequency to stress), its frequency means a strain that the
foam would not survive."""
STUCK = 128
"""Condition of a pad: its frequency does not change while those of the cube's other pads do."""
NOISY = 256
"""Condition of a pad: the noise of its frequency is much larger than its calibration states, and
larger than that of the other pads of the cube."""
REPORTED = 512
"""Condition of a pad: the hub reports a fault."""
DRIFT = 1024
"""Condition of a pad: while nothing moves, its frequency shifts relative to the other pads of the
cube."""

WORDS = {
    OPEN: "open",
    SHORT: "short",
    RANGE: "out of range",
    STUCK: "stuck",
    NOISY: "noisy",
    REPORTED: "reported by the hub",
    DRIFT: "drifting",
}
"""Text for each condition of a pad, as diagnostics and tables show it."""

LEFT_OUT = OPEN | SHORT | RANGE | STUCK | NOISY | REPORTED
"""Conditions with which the signal of a pad is not used in the reconstruction of the stress.

A drifting pad is still used, because its error is small and a tare (taking the present frequencies
as those without load) corrects it.
"""


def describe_status(status: int) -> str:
    """Return the names of the status bits of a row in words, such as "pad fault, residual"."""
    names = (name for name, bit in STATUS.items() if status & bit)
    return ", ".join(names).lower().replace("_", " ")
