"""Modes: linear stress fields in equilibrium, the unknowns that a cube recovers.

Mode m is the field sigma_ij(x) = S_ij + G_ijk x_k / d0, with amplitude in Pa. A name says what it
is:

    zz            uniform sigma_zz
    zz_x          sigma_zz growing along x: d0 d(sigma_zz)/dx
    xy_y-zx_z     two shear gradients whose divergences cancel

Sources: equilibrium, d(sigma_ij)/dx_j = 0; the plane modes are those of the paper's eq. 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .errors import SymmetryError
from .layout import AXES

STRESS = ("xx", "yy", "zz", "yz", "zx", "xy")
GRADIENT = tuple(f"{a}{a}_{b}" for a in AXES for b in AXES)
COMPONENTS = (
    STRESS + GRADIENT
)  # what is published: 6 stresses, then 9 normal gradients, rows xx yy zz
_PAIRS = tuple((AXES.index(n[0]), AXES.index(n[1])) for n in STRESS)


def to_matrix(stress: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) from components (..., 6) in the order xx, yy, zz, yz, zx,
    xy."""
    s = np.asarray(stress)
    return s[..., [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]


def to_six(matrix: np.ndarray) -> np.ndarray:
    """Components (..., 6) in the order xx, yy, zz, yz, zx, xy from symmetric matrices (..., 3,
    3)."""
    m = np.asarray(matrix)
    return np.stack([m[..., i, j] for i, j in _PAIRS], axis=-1)


@dataclass(frozen=True, eq=False)
class Modes:
    """A set of modes: names, uniform parts stress (M, 3, 3), linear parts gradient (M, 3, 3, 3)."""

    names: tuple[str, ...]
    stress: np.ndarray
    gradient: np.ndarray

    @property
    def n_modes(self) -> int:
        return len(self.names)

    @property
    def fields(self) -> np.ndarray:
        """(36, M): column m is mode m as 9 stresses followed by 27 gradients, both row-major."""
        m = self.n_modes
        return np.concatenate([self.stress.reshape(m, 9), self.gradient.reshape(m, 27)], axis=1).T

    @cached_property
    def reading(self) -> np.ndarray:
        """(M, 36): how each amplitude is read off a field; reading @ fields = 1."""
        rows = np.zeros((self.n_modes, 36))
        for row, name in zip(rows, self.names, strict=True):
            terms = _terms(name)
            for sign, place in terms:
                row[place] = sign / len(terms)
        rows.flags.writeable = False
        return rows

    @property
    def components(self) -> np.ndarray:
        """(15, M): takes a state to the COMPONENTS, gradients times d0, all in Pa."""
        rows = np.zeros((len(COMPONENTS), 36))
        for row, name in zip(rows, COMPONENTS, strict=True):
            for part in {name, name[1::-1] + name[2:]}:  # zx is the mean of sigma_zx and sigma_xz
                row[_terms(part)[0][1]] = 1.0
            row /= row.sum()
        return rows @ self.fields

    def state(self, stress: np.ndarray, gradient: np.ndarray | None = None) -> np.ndarray:
        """Amplitudes (N, M) in Pa of given fields.

        stress: (N, 6) or (N, 3, 3) in Pa; gradient: (N, 3, 3, 3) d(sigma_ij)/dx_k times d0 in Pa,
        or None. What the modes cannot express (a field out of equilibrium, out of the plane) is
        left out.
        """
        s = np.asarray(stress, dtype=float)
        s = (to_matrix(s) if s.shape[-1] == 6 else s).reshape(-1, 9)
        g = (
            np.zeros((len(s), 27))
            if gradient is None
            else np.asarray(gradient, dtype=float).reshape(-1, 27)
        )
        return np.concatenate([s, g], axis=1) @ self.reading.T

    def field(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of state: stress (N, 3, 3) and gradient times d0 (N, 3, 3, 3), both in Pa."""
        flat = np.asarray(state, dtype=float).reshape(-1, self.n_modes) @ self.fields.T
        return flat[:, :9].reshape(-1, 3, 3), flat[:, 9:].reshape(-1, 3, 3, 3)

    def action(self, rotation: np.ndarray) -> np.ndarray:
        """(M, M) matrix that turns states when the field is turned by a rotation or mirror (3, 3).

        S'_ij = R_ia R_jb S_ab and G'_ijk = R_ia R_jb R_kc G_abc. SymmetryError when the turned
        modes are no longer combinations of the modes, such as plane modes turned out of their
        plane.
        """
        r = np.asarray(rotation, dtype=float)
        turned = self.fields.copy()
        turned[:9] = np.kron(r, r) @ turned[:9]
        turned[9:] = np.kron(np.kron(r, r), r) @ turned[9:]
        action = self.reading @ turned
        if not np.allclose(self.fields @ action, turned, atol=1e-9):
            raise SymmetryError(
                f"the modes {', '.join(self.names)} do not stay among themselves under {r.tolist()}"
            )
        return action

    def index(self, names: Sequence[str]) -> list[int]:
        """Columns of the named modes; SymmetryError when one is unknown."""
        for name in names:
            if name not in self.names:
                raise SymmetryError(f"unknown mode {name!r}; the modes are {', '.join(self.names)}")
        return [self.names.index(name) for name in names]


def _terms(name: str) -> list[tuple[float, int]]:
    """Signs and places among the 36 of the parts of a mode's name."""
    terms = []
    for number, part in enumerate(name.split("-")):
        i, j = AXES.index(part[0]), AXES.index(part[1])
        place = 3 * i + j if len(part) == 2 else 9 + 9 * i + 3 * j + AXES.index(part[3])
        terms.append((-1.0 if number else 1.0, place))
    return terms


def _modes(names: Sequence[str], shears: str, symmetric: bool = True) -> Modes:
    """Modes by name; `shears` are the axes over which the balance of a gradient ii_i is spread."""
    flat = np.zeros((len(names), 36))
    for row, name in zip(flat, names, strict=True):
        for sign, place in _terms(name):
            row[place] = sign
    stress, gradient = flat[:, :9].reshape(-1, 3, 3), flat[:, 9:].reshape(-1, 3, 3, 3)
    if symmetric:
        stress = stress + np.where(stress == 0, stress.transpose(0, 2, 1), 0)
        gradient = gradient + np.where(gradient == 0, gradient.transpose(0, 2, 1, 3), 0)
    for g, name in zip(gradient, names, strict=True):
        if (
            name in GRADIENT and name[0] == name[3]
        ):  # equilibrium: the shears' divergence cancels the normal one's
            i = AXES.index(name[0])
            for j in (AXES.index(a) for a in shears if a != name[0]):
                g[i, j, j] = g[j, i, j] = -1 / (len(shears) - 1)
    stress.flags.writeable = gradient.flags.writeable = False
    return Modes(tuple(names), stress, gradient)


_PLANE_GRADIENT = ("zz_x", "zz_z", "xx_z", "xx_x")

# zz_z carries sigma_zx = -x and xx_x carries sigma_zx = -z, as equilibrium in the plane z-x demands
PLANE = _modes(("zz", "zx", "xx", *_PLANE_GRADIENT), "zx")
# the paper's own eight, sigma_zx and sigma_xz apart: for comparison only
PAPER = _modes(("zz", "zx", "xx", "xz", *_PLANE_GRADIENT), "zx", symmetric=False)
# ii_i is balanced half by each of the two shears; the cube group acts as signed permutations on
# these 21
SPACE = _modes(
    (*STRESS, *GRADIENT, "yz_x", "zx_y", "xy_z", "xy_y-zx_z", "yz_z-xy_x", "zx_x-yz_y"), "xyz"
)
