# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Influence functions: stress of each pad of a cube under a unit force, by the force's position.

They are stored in files (.npz).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ..config.input_files import read_arrays
from ..config.output_files import write_atomically
from ..core.arrays import Array
from ..core.errors import ConfigError, CubeError
from ..core.layout import Layout
from .cache import Arrays
from .layer import Layer

SCHEMA = 1
"""Version of the format of influence files; a file with another version is refused."""

MAX_FILE_BYTES = 64 << 20
"""Maximum size in bytes of a file of influence functions, also after decompression. The limit
protects against damaged or malicious files."""

MAX_INTEGER = 30_000
"""Integer as which the largest absolute stress of a file is stored. Stresses are stored as 16-bit
integers; their rounding error is a tenth of the error of the finite elements."""

_NUMBERS = ("pad_size", "side", "depth", "thickness", "poisson", "step")
"""Names of the arrays of a file of influence functions that hold one number each."""
_TABLES = ("positions", "normals", "place", "pads")
"""Names of the arrays of a file of influence functions that hold several numbers each: positions
and normals of the pads, positions of the forces, and the stresses of the pads."""

_PARSE_ERRORS = (OSError, KeyError, TypeError, ValueError)
"""Exceptions that are raised if a file of influence functions cannot be read, lacks an array, or
has an array of another type or shape."""


@dataclass(frozen=True, eq=False)
class Influence:
    """Influence functions of the pads (sensing elements) of a cube in an elastic layer.

    They are tabulated on a grid of positions of the force on the surface. Finite elements computed
    them, either in space (dim = 3 components of the force) or in a plane (dim = 2).

    Attributes:
        layout: Positions, normals and size of the P pads on the cube.
        side: Side length of the cube, in m.
        layer: Layer on rigid ground that contains the cube.
        depth: Distance from the centre of the cube to the surface, in m.
        place: Positions (n, dim - 1) of the forces in m, from the point of the surface above the
            centre of the cube: a sorted rectangular grid of x and, in space, y.
        pads: Mean normal stress (P, n, dim) of each pad under a unit force along x, y (only in
            space) and z at each position: in Pa per N in space, in Pa per N/m in a plane. Tension
            is positive.
    """

    layout: Layout
    side: float
    layer: Layer
    depth: float
    place: Array
    pads: Array

    def interpolate(self, place: Array) -> Array:
        """Interpolate the pad stresses between the positions of the grid, with cubic splines.

        Args:
            place: Positions (m, dim - 1) of forces on the surface, in m from the point above the
                cube's centre.

        Returns:
            Stress (P, m, dim) of each pad per unit force, where the last index is the direction of
            the force; 0 for positions outside of the grid.
        """
        return np.moveaxis(self._splines(place), 0, 1)

    @property
    def reach(self) -> float:
        """Radius in m of the largest circle within the grid about the point above the cube."""
        smallest = -self.place.min(axis=0).max()
        largest = self.place.max(axis=0).min()
        return float(min(smallest, largest))

    @cached_property
    def _splines(self) -> RegularGridInterpolator:
        """Cubic splines through the tabulated stresses, whose set-up takes tenths of a second."""
        # The grid contains all combinations of its x and y coordinates, sorted by x, then by y.
        axes = [np.unique(column) for column in self.place.T]
        stresses = np.moveaxis(self.pads, 1, 0)
        grid_shape = [len(axis) for axis in axes]
        grid = stresses.reshape(*grid_shape, *stresses.shape[1:])
        return RegularGridInterpolator(
            tuple(axes),
            grid,
            "cubic",
            bounds_error=False,
            fill_value=0.0,
        )


def write_influence(
    path: Path,
    influence: Influence,
    made_by: str,
) -> None:
    """Write influence functions to a file. If writing fails, an existing file stays unchanged.

    Args:
        path: File to write.
        influence: Influence functions.
        made_by: Command that computed them; it is stored in the file.

    Raises:
        ConfigError: The file cannot be written.
    """
    # Stresses are stored as 16-bit integers instead of floats, because such a file is part of the
    # package and should be small.
    step = np.abs(influence.pads).max() / MAX_INTEGER
    layout = influence.layout
    with write_atomically(path) as partial, partial.open("wb") as file:
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
    """Read and check influence functions of a 3-D model (forces along x, y and z).

    A file of a plane model is refused.

    Args:
        path: File (.npz) as from `write_influence`.

    Raises:
        ConfigError: The file is missing, damaged or inconsistent.
    """
    try:
        influence = _parse(read_arrays(path, MAX_FILE_BYTES))
        _check(influence)
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file; make it with ./cube fem MODEL --load surface"
        ) from None
    except (CubeError, *_PARSE_ERRORS) as error:
        # A KeyError contains only the name of the missing array.
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise ConfigError(
            f"{path}: {reason}; make the file again with ./cube fem MODEL --load surface "
            "-o FILE.npz"
        ) from None
    return influence


def _parse(arrays: Arrays) -> Influence:
    """Build the influence functions from the arrays of a file.

    Args:
        arrays: Arrays by the names under which `write_influence` stores them.

    Raises:
        ConfigError: The file has another version of the format (`SCHEMA`).
        ElasticError: The layer's thickness or Poisson's ratio is out of range.
        KeyError: An array is missing.
        TypeError, ValueError: An array has another type or shape.
    """
    schema = arrays["schema"].item()
    if schema != SCHEMA:
        raise ConfigError(f"schema is {schema}, this package reads {SCHEMA}")
    number = {name: float(arrays[name].item()) for name in _NUMBERS}
    # Complex numbers and texts cannot be cast safely, so they are refused here.
    table = {name: arrays[name].astype(float, casting="safe") for name in _TABLES}
    layout = Layout(
        str(arrays["layout"]),
        table["positions"],
        table["normals"],
        number["pad_size"],
    )
    return Influence(
        layout=layout,
        side=number["side"],
        layer=Layer(number["thickness"], number["poisson"]),
        depth=number["depth"],
        place=table["place"],
        pads=table["pads"] * number["step"],
    )


def _check(influence: Influence) -> None:
    """Check that the quantities of a file of influence functions do not contradict each other.

    Raises:
        ElasticError: The depth is not within the layer.
        ConfigError: The cube reaches the surface, an array has a wrong shape or is not finite, or
            the positions of the forces are no rectangular grid around the cube.
    """
    influence.layer.check_depth(influence.depth)
    if not 0 < influence.side < 2 * influence.depth:
        raise ConfigError(
            f"the cube has a side of {influence.side} m at a depth of {influence.depth} m; it must "
            "lie below the surface"
        )

    place = influence.place
    if place.ndim != 2 or place.shape[1] != 2:
        raise ConfigError(f"place has shape {place.shape}, needed is (n, 2)")
    shape = (influence.layout.n_pads, len(place), 3)
    if influence.pads.shape != shape:
        raise ConfigError(f"pads have shape {influence.pads.shape}, needed is {shape}")
    has_places = np.isfinite(place).all()
    has_stresses = np.isfinite(influence.pads).all()
    if not (has_places and has_stresses):
        raise ConfigError("a position or a stress is not finite")

    axes = [np.unique(column) for column in place.T]
    x, y = np.meshgrid(*axes, indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel()])
    is_grid = np.array_equal(place, grid)
    # Cubic interpolation needs four points per axis.
    if min(x.shape) < 4 or not is_grid or not influence.reach > 0:
        raise ConfigError("the positions are no grid of at least 4 x 4 points around the cube")
