"""Arrays that take seconds to compute, kept in the user's cache folder for the next time.

A file is named by a hash of what its arrays are made from, the code included. A file that is
damaged, or of another version, is made again; where nothing can be written, nothing is kept.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 1 << 30
"""Of all files; the ones that were used longest ago go first."""
_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
_CODE = (
    "mechanics/layer.py",
    "mechanics/circular.py",
    "mechanics/spectra.py",
    "mechanics/kernels.py",
    "mechanics/disc_tables.py",
    "mechanics/polygon_tables.py",
    "mechanics/cache.py",
    "touch/prior.py",
    "touch/flattened.py",
    "touch/windows.py",
)

Arrays = dict[str, NDArray[Any]]


def cache_folder() -> Path:
    """`cube_tensor_driver` below XDG_CACHE_HOME, which is ~/.cache if it is not set."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "cube_tensor_driver"


def cached(kind: str, made_from: Iterable[Any], make: Callable[[], Arrays]) -> Arrays:
    """The arrays that `make` gives for numbers and arrays that they are made from."""
    path = cache_folder() / f"{kind}-{_digest(made_from)}.npz"
    found = _read(path)
    if found is None:
        found = make()
        with suppress(OSError):
            _write(path, found)
    return found


def _digest(made_from: Iterable[Any]) -> str:
    digest = hashlib.sha256()
    for name in _CODE:
        with suppress(OSError):
            digest.update((Path(__file__).parents[1] / name).read_bytes())
    for one in made_from:
        array = np.ascontiguousarray(one)
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def _read(path: Path) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as file:  # its checksums find damage
            found = dict(file)
        os.utime(path)
    except _DAMAGE:
        return None
    return found


def _write(path: Path, arrays: Arrays) -> None:
    """Completely or not at all, whoever else writes the same."""
    size = sum(array.nbytes for array in arrays.values())
    if size > MOST_BYTES:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        try:
            np.savez(file, allow_pickle=False, **arrays)
            file.close()
            Path(file.name).replace(path)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise
    _make_room(path)


def _make_room(newest: Path) -> None:
    """Remove the files that were used longest ago, until all fit."""
    files = sorted(
        (path for path in newest.parent.glob("*.npz") if path != newest),
        key=lambda path: path.stat().st_mtime,
        reverse=True,
    )
    total = newest.stat().st_size
    for path in files:
        total += path.stat().st_size
        if total > MOST_BYTES:
            path.unlink(missing_ok=True)
