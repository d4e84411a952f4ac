# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the arguments of the public Python functions, and of the numbers in files."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Sequence
from numbers import Real

import numpy as np

from .arrays import Array
from .errors import ConfigError, CubeError


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


def read_numbers(
    value: object,
    name: str,
    error: type[CubeError],
    shape: tuple[int, ...] | None = None,
) -> Array:
    """Return finite numbers as a read-only array.

    Args:
        value: Number, or nested list of numbers.
        name: Name of the value, for the error message.
        error: Class of the error that is raised if the value does not consist of finite numbers, or
            has another shape.
        shape: Shape that the array must have; None allows any shape.
    """
    if not isinstance(value, np.ndarray):
        # numpy would convert texts and truth values to numbers, but in a file they are mistakes.
        items = np.asarray(value, dtype=object).ravel()
        if any(isinstance(item, (str, bool)) or item is None for item in items):
            raise error(f"{name} is {value!r}; it must be numbers (write 2.0e-3 with its point)")
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise error(f"{name} is {value!r}; it must be numbers") from None
    if shape is not None and array.shape != shape:
        raise error(f"{name} has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise error(f"{name} holds NaN or Inf; every value must be finite")
    array.flags.writeable = False
    return array


def join_names(names: Sequence[str], limit: int) -> str:
    """Return a text with the first names, such as "a, b and 3 more", for an error message.

    Args:
        names: The names.
        limit: Maximum number of names that are listed; of further names the number is stated.
    """
    listed = ", ".join(names[:limit])
    n_hidden = len(names) - limit
    return f"{listed} and {n_hidden} more" if n_hidden > 0 else listed
