"""Files of influence functions: numpy's arrays in a zip file (.npz)."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from ..config.atomic_write import atomic_write
from ..config.input_files import read_bounded
from ..core.errors import ConfigError, CubeError
from ..core.layout import Layout
from .influence import Influence
from .layer import Layer

SCHEMA = 1
LIMIT = 64 << 20
"""Bytes of a file and of what is in it."""
STEPS = 30_000
"""The greatest value is so many of the steps that values are rounded to: ten times finer than the
finite elements they come from."""
_DAMAGE = (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile)


def write_influence(path: Path, influence: Influence, made_by: str) -> None:
    """Write influence functions, completely or not at all. Raises ConfigError if it cannot.

    made_by: the command
    """
    step = np.abs(influence.pads).max() / STEPS
    layout = influence.layout
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            schema=SCHEMA,
            made_by=made_by,
            layout=layout.name,
            positions=layout.positions,
            normals=layout.normals,
            pad_size=layout.pad_size,
            side=influence.side,
            depth=influence.depth,
            thickness=influence.layer.thickness,
            poisson=influence.layer.poisson,
            place=influence.place,
            step=step,
            pads=np.round(influence.pads / step).astype(np.int16),
        )


def read_influence(path: Path) -> Influence:
    """Read and check influence functions of a cube in space. Raises ConfigError if it cannot."""
    try:
        return _influence(read_bounded(path, LIMIT, "file of influence functions"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; make it with ./cube fem --surface --3d") from None
    except (CubeError, *_DAMAGE) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise ConfigError(
            f"{path}: {reason}; make the file again with ./cube fem --surface --3d --influence"
        ) from None


def _influence(data: bytes) -> Influence:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > LIMIT:
        raise ConfigError(f"holds {size} bytes, the limit is {LIMIT}")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        found = dict(arrays)
    if int(found["schema"]) != SCHEMA:
        raise ConfigError(f"schema is {found['schema']}, this package reads {SCHEMA}")
    layout = Layout(
        str(found["layout"]), found["positions"], found["normals"], float(found["pad_size"])
    )
    place, pads = found["place"].astype(float), found["pads"] * float(found["step"])
    influence = Influence(
        layout=layout,
        side=float(found["side"]),
        layer=Layer(float(found["thickness"]), float(found["poisson"])),
        depth=float(found["depth"]),
        place=place,
        pads=pads,
    )
    influence.layer.check_depth(influence.depth)
    _check(influence)
    return influence


def _check(influence: Influence) -> None:
    place, pads = influence.place, influence.pads
    if not 0 < influence.side < 2 * influence.depth:
        raise ConfigError(
            f"the cube has a side of {influence.side} m at a depth of {influence.depth} m; it must "
            "lie below the surface"
        )
    if place.ndim != 2 or place.shape[1] != 2:
        raise ConfigError(f"place has shape {place.shape}, needed is (n, 2)")
    if pads.shape != (influence.layout.n_pads, len(place), 3):
        raise ConfigError(
            f"pads have shape {pads.shape}, needed is {(influence.layout.n_pads, len(place), 3)}"
        )
    if not (np.isfinite(place).all() and np.isfinite(pads).all()):
        raise ConfigError("a place or a value is not finite")
    x, y = np.meshgrid(*(np.unique(column) for column in place.T), indexing="ij")
    whole = np.column_stack([x.ravel(), y.ravel()])
    if min(x.shape) < 4 or not np.array_equal(place, whole) or not influence.reach > 0:
        raise ConfigError("the places are no grid around the cube")
