"""Status bits of rows and conditions of pads, with the values that SkinStress.msg states."""

from __future__ import annotations

PAD_FAULT = 1
"""Status bit: at least one pad was left out, because the device reports a fault or its frequency
is impossible."""

RESIDUAL = 2
"""Status bit: chi-square is above its false-alarm limit.

Either the load causes a stress field that the modes do not express, or a pad is broken.
"""

INVALID = 4
"""Status bit: no component was recovered, so all of them are NaN."""

TEMPERATURE = 8
"""Status bit: the temperature that the calibration needs is unknown.

The reference temperature of the calibration was assumed instead.
"""

STAMP = 2048
"""Status bit: the time stamp is doubtful.

The clock of the device seems to have been set, or the counter that it sends is not a clock.
"""

STATUS = {
    "PAD_FAULT": PAD_FAULT,
    "RESIDUAL": RESIDUAL,
    "INVALID": INVALID,
    "TEMPERATURE": TEMPERATURE,
    "STAMP": STAMP,
}
"""Status bits by name, as messages and tables show them."""

OPEN = 16
"""Condition of a pad: its frequency is so high that its capacitor must be disconnected."""
SHORT = 32
"""Condition of a pad: it has no frequency, as with a short circuit."""
RANGE = 64
"""Condition of a pad: its frequency stands for a strain that the elastomer does not survive."""
STUCK = 128
"""Condition of a pad: its frequency does not change while the other pads of the cube move."""
NOISY = 256
"""Condition of a pad: it is much noisier than its calibration and the other pads of the cube."""
REPORTED = 512
"""Condition of a pad: the hub reports a fault."""
DRIFT = 1024
"""Condition of a pad: its rest frequency moves away from those of the other pads of the cube."""

WORDS = {
    OPEN: "open",
    SHORT: "short",
    RANGE: "out of range",
    STUCK: "stuck",
    NOISY: "noisy",
    REPORTED: "reported by the hub",
    DRIFT: "drifting",
}
"""Words for the conditions of a pad, as diagnostics and tables show them."""

LEFT_OUT = OPEN | SHORT | RANGE | STUCK | NOISY | REPORTED
"""Conditions with which a pad is left out of the reconstruction.

A drifting pad is still used, because its error is small and a tare corrects it.
"""
