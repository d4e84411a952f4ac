"""Status bits of rows and pads, as in SkinStress.msg."""

from __future__ import annotations

PAD_FAULT = (
    1  # at least one pad was left out: fault bit of the device, or a frequency that no pad can have
)
RESIDUAL = 2  # chi-square above its false-alarm limit: a load outside the modes, or a broken pad
INVALID = 4  # nothing recovered: all components NaN
TEMPERATURE = (
    8  # the temperature is unknown though the calibration needs it; its reference was assumed
)
STATUS = {
    "PAD_FAULT": PAD_FAULT,
    "RESIDUAL": RESIDUAL,
    "INVALID": INVALID,
    "TEMPERATURE": TEMPERATURE,
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
"""A pad with one of these is not used; one that drifts still is: only tare knows better."""
