"""The DDS domain of this process and of those that it starts."""

from __future__ import annotations

import os

from ..core.errors import ConfigError

VARIABLE = "ROS_DOMAIN_ID"
HIGHEST = 232
"""The UDP ports of higher domains do not exist."""


def check_domain() -> None:
    """Raise ConfigError if ROS_DOMAIN_ID names no DDS domain: the middleware would fail later,
    and not say why."""
    text = os.environ.get(VARIABLE, "")
    try:
        fits = not text or 0 <= int(text) <= HIGHEST
    except ValueError:
        fits = False
    if not fits:
        raise ConfigError(f"{VARIABLE} is {text!r}, allowed: 0 to {HIGHEST}; set it or unset it")
