"""Status bits of rows and pads, as in SkinStress.msg."""

from __future__ import annotations

PAD_FAULT = 1
"""At least one pad was left out: the device reports it, or its frequency is impossible."""
RESIDUAL = 2
"""Chi-square is above its false-alarm limit: a load outside the modes, or a broken pad."""
INVALID = 4
"""Nothing was recovered: all components are NaN."""
TEMPERATURE = 8
"""The calibration needs the temperature, which is unknown; its reference was assumed."""
STAMP = 2048
"""The stamp is in doubt: the device's clock seems to have been set, or is no clock."""
STATUS = {
    "PAD_FAULT": PAD_FAULT,
    "RESIDUAL": RESIDUAL,
    "INVALID": INVALID,
    "TEMPERATURE": TEMPERATURE,
    "STAMP": STAMP,
}

OPEN, SHORT, RANGE, STUCK, NOISY, REPORTED, DRIFT = 16, 32, 64, 128, 256, 512, 1024
WORDS = {
    OPEN: "open",
    SHORT: "short",
    RANGE: "out of range",
    STUCK: "stuck",
    NOISY: "noisy",
    REPORTED: "reported by the hub",
    DRIFT: "drifting",
}
LEFT_OUT = OPEN | SHORT | RANGE | STUCK | NOISY | REPORTED
"""A pad with one of these is not used. A drifting pad still is: only tare can correct it."""
