# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the arguments of the public Python functions."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from numbers import Real

from .errors import ConfigError


def check_number(
    name: str,
    value: object,
    is_allowed: Callable[[float], bool],
    allowed: str,
) -> None:
    """Check that an argument is a number in a range.

    Args:
        name: Name of the argument, for the error message.
        value: The argument.
        is_allowed: Returns whether a number is in the range.
        allowed: Description of the range, with its unit.

    Raises:
        ConfigError: The argument is no number, NaN, or out of the range.
    """
    if not isinstance(value, Real) or not is_allowed(float(value)):
        raise ConfigError(f"{name} is {value!r}, allowed: {allowed}")


def check_skin(skin: object, attribute: str) -> None:
    """Check that an argument is a skin.

    Args:
        skin: The argument.
        attribute: Name of the attribute of a skin that the caller uses.

    Raises:
        ConfigError: The argument is something else, such as the path of a skin file.
    """
    if not hasattr(skin, attribute):
        raise ConfigError(
            f"{reprlib.repr(skin)} is no skin; read_skin(path) reads one from its file"
        )
