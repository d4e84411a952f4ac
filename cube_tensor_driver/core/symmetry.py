# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Symmetry: the response matrices that a cube can have, given the symmetry of its surroundings.

The response A (pads x modes) gives the stresses on the pads per amplitude of each mode (linear
stress field). Every element R of the symmetry group permutes the pads (P(R)) and transforms the
modes (M(R)), and A satisfies A M(R) = P(R) A for all R. Both P(R) and M(R) are signed permutations,
so the entries of A form orbits (sets that the group maps onto each other) of equal magnitude. Each
orbit is one coefficient, named after one of its entries.

Source: Kiyota & Shinoda, the symmetry argument for eq. 1, applied to any layout.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .arrays import Array, Index
from .errors import SymmetryError
from .layout import Layout
from .modes import PLANE, SPACE, Modes

POSITION_TOLERANCE = 1e-6
"""Largest distance between a rotated pad and another pad at which the two count as coincident, in
units of d0 (half the side of the cube)."""

_QUARTER_TURN_Z = (
    (0, -1, 0),
    (1, 0, 0),
    (0, 0, 1),
)
"""Rotation by 90 degrees about z: the axis x becomes y, and y becomes -x."""
_CYCLE_AXES = (
    (0, 0, 1),
    (1, 0, 0),
    (0, 1, 0),
)
"""Rotation by 120 degrees about the diagonal of the cube: x becomes y, y becomes z, z becomes x."""
_MIRRORS = (
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
)
"""Reflections that reverse x, y and z."""
Matrix = Sequence[Sequence[int]]
"""Matrix of integers, as nested sequences of its rows."""

GENERATORS: dict[str, tuple[Matrix, ...]] = {
    "full": (_QUARTER_TURN_Z, _CYCLE_AXES, *_MIRRORS),
    "slab": (_QUARTER_TURN_Z, *_MIRRORS),
    "mirrors": _MIRRORS,
    "none": (),
}
"""Generators (matrices whose products are the group) of each symmetry group, the largest group
first. The symmetry is that of the cube with its surroundings.

- full (48 elements): the cube is alone in a wide body.
- slab (16): the direction z differs from x and y, but +z and -z are alike.
- mirrors (8): the three axes differ from each other.
- none (1): nothing is known, and every entry of the response is a coefficient of its own.
"""

_LETTERS = {
    "zz": ("a", 1),
    "xx": ("b", -1),
    "zx": ("c_plus_d", -1),
    "zz_x": ("e", -1),
    "xx_z": ("f", 1),
    "zz_z": ("g", -1),
    "xx_x": ("h", 1),
}
"""Mode (linear stress field) -> name and sign of the coefficient that is the response of the first
pad to it. The names are the letters of Kiyota & Shinoda (eq. 1), who call this pad V1. The mode zx
has equal stresses sigma_zx and sigma_xz, so its response is c + d."""
_PAPER_LETTERS = _LETTERS | {"zx": ("c", -1), "xz": ("d", -1)}
"""Mode -> name and sign of the coefficient, as in `_LETTERS`, but for the eight modes `PAPER` of
Kiyota & Shinoda. There, the shear stresses sigma_zx and sigma_xz are two modes, each with a
coefficient of its own."""


def generate_group(generators: Sequence[Matrix]) -> Index:
    """Return all G different products (G, 3, 3) of the generators, the identity first."""
    matrices = [np.array(generator, dtype=int) for generator in generators]
    identity = np.eye(3, dtype=int)
    found = {identity.tobytes(): identity}
    newest = [identity]
    while newest:
        products = [generator @ element for element in newest for generator in matrices]
        newest = []
        for product in products:
            if product.tobytes() not in found:
                found[product.tobytes()] = product
                newest.append(product)
    return np.array(list(found.values()))


def find_group(name: str) -> Index:
    """Return the elements (G, 3, 3) of a symmetry group: its rotations and mirrors.

    Each is a matrix with one entry 1 or -1 in each row and column.

    Raises:
        SymmetryError: There is no group of this name.
    """
    if name not in GENERATORS:
        raise SymmetryError(f"unknown symmetry {name!r}; known are {', '.join(GENERATORS)}")
    return generate_group(GENERATORS[name])


def find_layout_group(layout: Layout, name: str) -> Index:
    """Return the elements (G, 3, 3) of a symmetry group that apply to a layout.

    All pads of a planar layout lie in the plane y = 0. For it, only the elements that map this
    plane onto itself are returned.

    Args:
        layout: Layout of the pads.
        name: Name of the symmetry group.

    Raises:
        SymmetryError: There is no group of this name.
    """
    elements = find_group(name)
    if not layout.planar:
        return elements
    keeps_plane = np.abs(elements[:, 1, 1]) == 1
    planar: Index = elements[keeps_plane]
    return planar


def map_pads(layout: Layout, rotation: Array | Index) -> Index:
    """Return, for each pad, the number of the pad onto which a rotation or mirror maps it (P,).

    Args:
        layout: Layout of the P pads.
        rotation: Rotation or mirror matrix (3, 3).

    Raises:
        SymmetryError: There is no pad at the position to which a pad is mapped.
    """
    images = np.empty(layout.n_pads, dtype=int)
    positions = layout.positions @ rotation.T
    normals = layout.normals @ rotation.T
    for pad in range(layout.n_pads):
        offset = np.abs(layout.positions - positions[pad])
        rotation_error = np.abs(layout.normals - normals[pad])
        largest = np.maximum(offset, rotation_error).max(axis=1)
        matches = np.flatnonzero(largest < POSITION_TOLERANCE)
        if not len(matches):
            raise SymmetryError(
                f"layout {layout.name!r} lacks this symmetry: pad {layout.pads[pad]!r} would be "
                f"carried to {positions[pad].round(6).tolist()} on face "
                f"{normals[pad].astype(int).tolist()}, where there is no pad; choose a smaller "
                f"group of {', '.join(GENERATORS)}"
            )
        images[pad] = matches[0]
    return images


@dataclass(frozen=True, eq=False)
class Structure:
    """All response matrices (pads x modes) that a symmetry allows: sum_k coefficient_k basis_k.

    Attributes:
        layout: Layout of the P pads.
        modes: The M modes (linear stress fields).
        symmetry: Name of the symmetry group.
        names: Names of the K coefficients. A name such as "+z-x:zz" means the entry of the response
            for the pad "+z-x" and the mode "zz".
        basis: One matrix per coefficient (K, P, M) with entries 0, 1 and -1. At each entry of the
            response, at most one of the K matrices is not 0.
    """

    layout: Layout
    modes: Modes
    symmetry: str
    names: tuple[str, ...]
    basis: Array

    @property
    def n_coefficients(self) -> int:
        """Number K of coefficients that determine the response matrix."""
        return len(self.names)

    @property
    def pad_orbits(self) -> list[list[int]]:
        """Sets of pads that the symmetry maps onto each other."""
        elements = find_layout_group(self.layout, self.symmetry)
        images = np.array([map_pads(self.layout, element) for element in elements])
        # All pads of one orbit have the same set of images, so each set is added only once.
        orbits: list[list[int]] = []
        for column in images.T:
            orbit = np.unique(column).tolist()
            if orbit not in orbits:
                orbits.append(orbit)
        return orbits


def choose_default_modes(layout: Layout) -> Modes:
    """Return the modes (components of stress and gradient) that a layout of pads can measure.

    They are `PLANE` for pads in one plane, `SPACE` otherwise.
    """
    return PLANE if layout.planar else SPACE


@lru_cache(maxsize=64)
def find_structure(
    layout: Layout,
    symmetry: str = "full",
    modes: Modes | None = None,
) -> Structure:
    """Derive the response matrices (pads x modes) that a symmetry allows for a layout.

    Args:
        layout: Layout of the pads.
        symmetry: Name of the symmetry group, a key of `GENERATORS`.
        modes: Modes (linear stress fields); by default `choose_default_modes` of the layout.

    Raises:
        SymmetryError: The layout does not have this symmetry.
    """
    modes = modes or choose_default_modes(layout)
    elements = find_layout_group(layout, symmetry)
    pad_images = np.array([map_pads(layout, element) for element in elements])
    actions = [modes.compute_action(element) for element in elements]
    mode_images, mode_signs = _read_signed_permutations(np.array(actions))

    letters: dict[str, tuple[str, int]] = {}
    images_of_first = set(pad_images[:, 0])
    is_one_orbit = len(images_of_first) == np.sum(~layout.is_dummy)
    if is_one_orbit and layout.planar and layout.pads[0] == "+z-x":
        # Kiyota & Shinoda denote the coefficients of pad V1 by letters. The group maps V1 onto
        # every other pad, so the coefficients of the other pads are the same, except for signs.
        letters = _PAPER_LETTERS if "xz" in modes.names else _LETTERS

    is_assigned = np.zeros((layout.n_pads, modes.n_modes), dtype=bool)
    is_assigned[layout.is_dummy] = True  # a dummy pad responds to no mode
    members: list[tuple[str, Array]] = []
    for pad, mode in np.ndindex(is_assigned.shape):
        if is_assigned[pad, mode]:
            continue
        rows = pad_images[:, pad]
        columns = mode_images[:, mode]
        signs = mode_signs[:, mode]
        is_assigned[rows, columns] = True
        is_same_entry = (rows == pad) & (columns == mode)
        is_reversed = signs < 0
        if np.any(is_same_entry & is_reversed):
            # An element of the symmetry group maps the pad onto itself and reverses the sign of the
            # mode (linear stress field). So the entry equals its own negative and must be zero.
            continue
        mode_name = modes.names[mode]
        own_name = (f"{layout.pads[pad]}:{mode_name}", 1)
        name, letter_sign = letters.get(mode_name, own_name)
        member = np.zeros(is_assigned.shape)
        member[rows, columns] = letter_sign * signs
        members.append((name, member))

    if letters:
        members.sort(key=lambda pair: pair[0])
    names = tuple(name for name, _ in members)
    basis = np.array([member for _, member in members])
    basis = basis.reshape(-1, *is_assigned.shape)
    basis.flags.writeable = False
    return Structure(
        layout,
        modes,
        symmetry,
        names,
        basis,
    )


def _read_signed_permutations(matrices: Array) -> tuple[Index, Index]:
    """Return the row number and the sign of the nonzero entry in each column of matrices.

    Args:
        matrices: G signed permutations (G, M, M): each column has one entry 1 or -1, all others are
            0.

    Returns:
        Row numbers (G, M) and signs (G, M).

    Raises:
        SymmetryError: A matrix is not a signed permutation.
    """
    magnitude = np.abs(matrices)
    sums = magnitude.sum(axis=1)
    largest = magnitude.max(axis=1)
    if not (np.allclose(sums, 1) and np.allclose(largest, 1)):
        raise SymmetryError("the group does not act on these modes as signed permutations")
    nonzero = matrices.sum(axis=1)
    signs = np.sign(nonzero)
    return magnitude.argmax(axis=1), signs.astype(int)


def count_coefficients(layout: Layout) -> Iterator[tuple[str, int | None]]:
    """Count the coefficients of a layout's response under each symmetry group.

    Yields:
        Name of a group, the largest group first, and the number of coefficients; None if the layout
        does not have the symmetry.
    """
    for name in GENERATORS:
        try:
            yield name, find_structure(layout, name).n_coefficients
        except SymmetryError:
            yield name, None


def find_largest_symmetry(layout: Layout) -> str:
    """Return the name of the largest symmetry group that maps the pads of a layout onto each other.

    Groups under which all responses of the layout would be zero are skipped.
    """
    return next(name for name, count in count_coefficients(layout) if count)
