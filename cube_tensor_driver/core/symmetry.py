"""Symmetry: which response matrices a cube can have, given the group that its surroundings respect.

Every element R of the group permutes the pads (P(R)) and turns the modes (M(R)). The response A
obeys A M(R) = P(R) A for all R. Because both act as signed permutations, the entries of A fall into
orbits of equal magnitude. Each orbit is one coefficient, named after one of its entries.

Source: the symmetry argument of the paper's section on eq. 1, for any layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .errors import SymmetryError
from .layout import Layout
from .modes import PLANE, SPACE, Modes

_TURN_Z = ((0, -1, 0), (1, 0, 0), (0, 0, 1))
_CYCLE = ((0, 0, 1), (1, 0, 0), (0, 1, 0))
_MIRRORS = tuple(
    tuple(tuple(-1 if i == j == k else int(i == j) for j in range(3)) for i in range(3))
    for k in range(3)
)
GENERATORS: dict[str, tuple] = {
    "full": (_TURN_Z, _CYCLE, *_MIRRORS),  # 48: the cube alone in a wide body
    "slab": (_TURN_Z, *_MIRRORS),  # 16: z differs from x and y, but up and down are alike
    "mirrors": _MIRRORS,  # 8: three different axes
    "none": (),  # 1: nothing is known, every entry is its own coefficient
}

# The paper's letters, as entries of row V1 with its signs; used where all pads are images of V1.
_LETTERS = {
    "zz": ("a", 1),
    "xx": ("b", -1),
    "zx": ("c_plus_d", -1),
    "zz_x": ("e", -1),
    "xx_z": ("f", 1),
    "zz_z": ("g", -1),
    "xx_x": ("h", 1),
}
_PAPER_LETTERS = _LETTERS | {"zx": ("c", -1), "xz": ("d", -1)}


def closure(generators: Sequence) -> np.ndarray:
    """All products (G, 3, 3) of the generators, integers, the identity first."""
    identity = np.eye(3, dtype=int)
    found = {identity.tobytes(): identity}
    new = [identity]
    while new:
        products = [np.array(g, dtype=int) @ r for r in new for g in generators]
        new = []
        for r in products:
            if r.tobytes() not in found:
                found[r.tobytes()] = r
                new.append(r)
    return np.array(list(found.values()))


@lru_cache
def group(name: str) -> np.ndarray:
    """Elements (G, 3, 3) of a named group, signed permutation matrices; SymmetryError when
    unknown."""
    if name not in GENERATORS:
        raise SymmetryError(f"unknown symmetry {name!r}; known are {', '.join(GENERATORS)}")
    elements = closure(GENERATORS[name])
    elements.flags.writeable = False
    return elements


def layout_group(layout: Layout, name: str) -> np.ndarray:
    """The elements of a group that concern a layout: for a planar one, those that keep the plane y
    = 0."""
    elements = group(name)
    return elements[np.abs(elements[:, 1, 1]) == 1] if layout.planar else elements


def pad_images(layout: Layout, rotation: np.ndarray) -> np.ndarray:
    """(P,) the pad onto which a rotation or mirror carries each; SymmetryError names one without
    image."""
    r = np.asarray(rotation, dtype=float)
    images = np.empty(layout.n_pads, dtype=int)
    for pad, (x, n) in enumerate(zip(layout.positions @ r.T, layout.normals @ r.T, strict=True)):
        same = np.all(np.abs(layout.positions - x) < 1e-6, axis=1) & np.all(
            np.abs(layout.normals - n) < 1e-6, axis=1
        )
        if not same.any():
            raise SymmetryError(
                f"layout {layout.name!r} lacks this symmetry: pad {layout.pads[pad]!r} would be "
                f"carried to {x.round(6).tolist()} on face {n.astype(int).tolist()}, where there "
                f"is no pad; choose a smaller group of {', '.join(GENERATORS)}"
            )
        images[pad] = np.flatnonzero(same)[0]
    return images


def pad_action(layout: Layout, rotation: np.ndarray) -> np.ndarray:
    """(P, P) permutation matrix of the pads: the turned pad stresses are pad_action @ pad
    stresses."""
    action = np.zeros((layout.n_pads, layout.n_pads))
    action[pad_images(layout, rotation), np.arange(layout.n_pads)] = 1
    return action


@dataclass(frozen=True, eq=False)
class Structure:
    """All response matrices that a symmetry allows: sum_k coefficient_k basis_k.

    names: (K,) of the coefficients; a name such as "+z-x:zz" is the entry of that pad and mode
    basis: (K, P, M) with entries 0, 1, -1; every entry of a response belongs to at most one
    coefficient
    """

    layout: Layout
    modes: Modes
    symmetry: str
    names: tuple[str, ...]
    basis: np.ndarray

    @property
    def n_coefficients(self) -> int:
        return len(self.names)

    @property
    def pad_orbits(self) -> list[list[int]]:
        """Pads that the symmetry carries onto each other."""
        images = np.array(
            [pad_images(self.layout, r) for r in layout_group(self.layout, self.symmetry)]
        )
        return [
            list(orbit) for orbit in dict.fromkeys(tuple(np.unique(column)) for column in images.T)
        ]


def default_modes(layout: Layout) -> Modes:
    """PLANE for a planar layout, else SPACE."""
    return PLANE if layout.planar else SPACE


def find_structure(layout: Layout, symmetry: str = "full", modes: Modes | None = None) -> Structure:
    """The structure of a layout under a group; SymmetryError when the layout does not have the
    symmetry."""
    return _structure(layout, symmetry, modes or default_modes(layout))


@lru_cache(maxsize=64)
def _structure(layout: Layout, symmetry: str, modes: Modes) -> Structure:
    elements = layout_group(layout, symmetry)
    pads = np.array([pad_images(layout, r) for r in elements])
    actions = np.array([modes.action(r) for r in elements])
    images, signs = np.abs(actions).argmax(axis=1), np.sign(actions.sum(axis=1)).astype(int)
    if not np.allclose(np.abs(actions).sum(axis=1), 1) or not np.allclose(
        np.abs(actions).max(axis=1), 1
    ):
        raise SymmetryError("the group does not act on these modes as signed permutations")
    n_pads, n_modes = layout.n_pads, modes.n_modes
    seen = np.zeros((n_pads, n_modes), dtype=bool)
    names, basis = [], []
    letters: dict[str, tuple[str, int]] = {}
    if len(set(pads[:, 0])) == n_pads and layout.planar and layout.pads[0] == "+z-x":
        letters = _PAPER_LETTERS if "xz" in modes.names else _LETTERS
    for pad in range(n_pads):
        for mode in range(n_modes):
            if seen[pad, mode]:
                continue
            rows, columns, sign = pads[:, pad], images[:, mode], signs[:, mode]
            seen[rows, columns] = True
            if np.any((rows == pad) & (columns == mode) & (sign < 0)):
                continue  # an element that flips the mode but keeps the pad forbids this entry
            name, flip = letters.get(
                modes.names[mode], (f"{layout.pads[pad]}:{modes.names[mode]}", 1)
            )
            member = np.zeros((n_pads, n_modes))
            member[rows, columns] = flip * sign
            names.append(name)
            basis.append(member)
    if letters:
        names, basis = map(
            list,
            zip(*sorted(zip(names, basis, strict=True), key=lambda pair: pair[0]), strict=True),
        )
    stacked = np.array(basis).reshape(-1, n_pads, n_modes)
    stacked.flags.writeable = False
    return Structure(layout, modes, symmetry, tuple(names), stacked)


def coefficient_counts(layout: Layout) -> dict[str, int | None]:
    """Number of coefficients under each symmetry, the largest group first; None where the layout
    lacks it."""
    counts: dict[str, int | None] = {}
    for name in GENERATORS:
        try:
            counts[name] = find_structure(layout, name).n_coefficients
        except SymmetryError:
            counts[name] = None
    return counts


def largest_symmetry(layout: Layout) -> str:
    """The largest group whose response matrices are not all zero."""
    return next(name for name, count in coefficient_counts(layout).items() if count)


def count_by_characters(layout: Layout, symmetry: str, modes: Modes | None = None) -> int:
    """Number of coefficients as the mean over the group of (pads kept) x (trace on modes)."""
    modes = modes or default_modes(layout)
    elements = layout_group(layout, symmetry)
    total = sum(np.trace(pad_action(layout, r)) * np.trace(modes.action(r)) for r in elements)
    return round(total / len(elements))
