# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Cache of arrays that take seconds to compute, in the user's cache folder.

The name of a file contains a hash of everything its arrays depend on, the source code included. So
arrays are computed again if an input or the code has changed, or if their file is damaged. If the
folder cannot be written, they are computed at every start.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from ..config.input_files import read_arrays
from ..config.output_files import write_atomically
from ..core.arrays import AnyArray
from ..core.errors import ConfigError

MAX_CACHE_BYTES = 1 << 30
"""Maximum size of all cached files together, in bytes. Beyond it, the least recently used files are
removed."""

_CONTENT = "content"
"""Name of the array in each cached file that lists the other arrays of the file with their types
and shapes. By this list, a file that has lost an array is recognised."""

_CODE = ("mechanics", "touch")
"""Folders of the package with source files whose change makes all cached arrays invalid."""

Arrays = dict[str, AnyArray]
"""Arrays by name, as in one .npz file."""

Cached = TypeVar("Cached", bound=Mapping[str, AnyArray])
"""Arrays by name, with the types that a function computes."""


def find_cache_folder() -> Path:
    """Return the folder of the cached files, below XDG_CACHE_HOME or else below ~/.cache."""
    home = os.environ.get("XDG_CACHE_HOME")
    parent = Path(home) if home else Path.home() / ".cache"
    return parent / "cube_tensor_driver"


def load_or_compute(
    kind: str,
    inputs: Iterable[object],
    compute: Callable[[], Cached],
) -> Cached:
    """Load arrays from the cache, or compute and store them.

    Args:
        kind: Name of what is computed; the name of the file begins with it.
        inputs: Numbers and arrays on which the result depends.
        compute: Function that computes the arrays; it is called only if they are not in the cache.

    Returns:
        The arrays by name, the same whether they were loaded or computed.
    """
    path = find_cache_folder() / f"{kind}-{_hash_inputs(inputs)}.npz"

    arrays = _load(path)
    if arrays is not None:
        # The name of the file contains a hash of the inputs and of the code, so that an earlier
        # call of the same function has computed these arrays.
        return cast(Cached, arrays)

    computed = compute()
    with suppress(OSError, ConfigError):  # if the folder cannot be written, nothing is stored
        _store(path, computed)
    return computed


def _hash_inputs(inputs: Iterable[object]) -> str:
    """Return a hash of everything a cached result depends on, as 32 hexadecimal digits.

    Args:
        inputs: Numbers and arrays; their values, types and shapes enter the hash, together with the
            source files in `_CODE`.
    """
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for folder in _CODE:
        for path in sorted((package / folder).rglob("*.py")):
            digest.update(path.read_bytes())

    for value in inputs:
        array = np.ascontiguousarray(value)
        # Type and shape are included, because different arrays may consist of equal bytes.
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def _load(path: Path) -> Arrays | None:
    """Load the arrays of a cached file and mark the file as used now.

    Returns:
        Arrays by name; None if the file is missing or damaged, or cannot be marked.
    """
    try:
        # The limit is above that of `_store`, because a file contains headers besides the arrays.
        arrays = read_arrays(path, 2 * MAX_CACHE_BYTES)
        # The file's time becomes the time of its last use, by which `_make_room` sorts.
        os.utime(path)
    except (OSError, ConfigError):
        return None
    # The checksums in the file cover each array, but not how many there are.
    content = arrays.pop(_CONTENT, np.empty(0))
    return arrays if np.array_equal(content, _describe(arrays)) else None


def _describe(arrays: Mapping[str, AnyArray]) -> AnyArray:
    """Return name, type and shape of each array as an array of texts, such as "one <f8 (300,)"."""
    return np.array([f"{name} {one.dtype.str} {one.shape}" for name, one in arrays.items()])


def _store(path: Path, arrays: Mapping[str, AnyArray]) -> None:
    """Store arrays in a file, of which other processes never see an incomplete version.

    Arrays of more than `MAX_CACHE_BYTES` are not stored.

    Raises:
        OSError, ConfigError: The file cannot be written.
    """
    size = sum(array.nbytes for array in arrays.values())
    if size > MAX_CACHE_BYTES:
        return

    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as partial, partial.open("wb") as file:
        content = {_CONTENT: _describe(arrays)}
        np.savez(file, allow_pickle=False, **content, **arrays)
    _make_room(path)


def _make_room(newest: Path) -> None:
    """Remove the least recently used files until all files together fit into `MAX_CACHE_BYTES`.

    Args:
        newest: File that was just written, which is kept.
    """
    others = [path for path in newest.parent.glob("*.npz") if path != newest]
    others.sort(key=lambda path: path.stat().st_mtime, reverse=True)

    total = newest.stat().st_size
    for path in others:
        total += path.stat().st_size
        if total > MAX_CACHE_BYTES:
            path.unlink(missing_ok=True)
