"""Layouts: where the pads of a cube are.

Frame: z out of the skin, x and y along it. Lengths are in d0, the half side of the cube.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .errors import LayoutError

AXES = "xyz"
MAX_PADS = 32  # a fault mask on the wire has 32 bits
PAD_OFFSET = 0.5  # of the built-in layouts' pads from the face's centre
PAD_SIZE = 0.4


@dataclass(frozen=True, eq=False)
class Layout:
    """Pads of one kind of cube.

    name: what calibration and configuration files call it
    positions: (P, 3) pad centres in units of the half side d0
    normals: (P, 3) outward normals of the pads' faces, each plus or minus one axis
    pad_size: side of a (square) pad in units of d0
    Raises LayoutError when a pad is not on the face that its normal names, or two pads coincide.
    """

    name: str
    positions: np.ndarray
    normals: np.ndarray
    pad_size: float = PAD_SIZE

    def __post_init__(self) -> None:
        positions = _vectors(self.positions, "positions")
        normals = _vectors(self.normals, "normals")
        if len(positions) != len(normals):
            raise LayoutError(
                f"layout {self.name!r}: {len(positions)} positions but {len(normals)} normals"
            )
        if not 1 <= len(positions) <= MAX_PADS:
            raise LayoutError(
                f"layout {self.name!r}: {len(positions)} pads; allowed are 1 to {MAX_PADS}"
            )
        if not 0 < self.pad_size <= 2:
            raise LayoutError(
                f"layout {self.name!r}: pad_size {self.pad_size}; allowed is above 0, up to 2"
            )
        for i, (x, n) in enumerate(zip(positions, normals, strict=True)):
            if sorted(np.abs(n)) != [0, 0, 1]:
                raise LayoutError(
                    f"layout {self.name!r}: pad {i + 1} has normal {n.tolist()}; "
                    "a normal is one axis, such as [0, 0, -1]"
                )
            if abs(x @ n - 1) > 1e-9:
                raise LayoutError(
                    f"layout {self.name!r}: pad {i + 1} at {x.tolist()} is not on the face "
                    f"{n.tolist()}; its coordinate along the normal must be 1"
                )
            edge = np.max(np.abs(x - n * (x @ n))) + self.pad_size / 2
            if edge > 1 + 1e-9:
                raise LayoutError(
                    f"layout {self.name!r}: pad {i + 1} reaches {edge:.3g} from the face's centre; "
                    "the face ends at 1"
                )
            for j in range(i):
                if np.allclose(x, positions[j], atol=1e-9) and np.array_equal(n, normals[j]):
                    raise LayoutError(
                        f"layout {self.name!r}: pads {j + 1} and {i + 1} coincide at {x.tolist()}"
                    )
        positions.flags.writeable = normals.flags.writeable = False
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "pad_size", float(self.pad_size))

    @property
    def n_pads(self) -> int:
        return len(self.positions)

    @cached_property
    def pads(self) -> tuple[str, ...]:
        """Names that stay: face, then side of the face, such as "+z-x"; a second pad there is
        "+z-x#2"."""
        plain = [
            _signed_axes(n) + _signed_axes(x - n * (x @ n))
            for x, n in zip(self.positions, self.normals, strict=True)
        ]
        repeats = [plain[:i].count(name) for i, name in enumerate(plain)]
        return tuple(
            f"{name}#{k + 1}" if k else name for name, k in zip(plain, repeats, strict=True)
        )

    @property
    def planar(self) -> bool:
        """True when all pads and normals lie in the plane y = 0."""
        return not (np.any(np.abs(self.positions[:, 1]) > 1e-9) or np.any(self.normals[:, 1]))

    def index(self, pad: str) -> int:
        """Row of a pad by its name; LayoutError when there is none."""
        try:
            return self.pads.index(pad)
        except ValueError:
            raise LayoutError(
                f"layout {self.name!r} has no pad {pad!r}; its pads are {', '.join(self.pads)}"
            ) from None

    def same_as(self, other: Layout) -> bool:
        """True when both have the same pads in the same order."""
        return (
            self.positions.shape == other.positions.shape
            and self.pad_size == other.pad_size
            and np.allclose(self.positions, other.positions, atol=1e-9)
            and np.array_equal(self.normals, other.normals)
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain types, as from_dict takes them."""
        return {
            "name": self.name,
            "pad_size": self.pad_size,
            "positions": self.positions.tolist(),
            "normals": self.normals.tolist(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Layout:
        """A layout from plain types: name, positions, normals, optional pad_size.

        LayoutError: a key or value that is wrong.
        """
        if not isinstance(data, Mapping):
            raise LayoutError(f"a layout is a table with name, positions, normals; found {data!r}")
        unknown = set(data) - {"name", "positions", "normals", "pad_size"}
        missing = {"name", "positions", "normals"} - set(data)
        if unknown or missing:
            raise LayoutError(
                f"layout: unknown keys {sorted(unknown)}, missing keys {sorted(missing)}; "
                "allowed are name, positions, normals, pad_size"
            )
        size = data.get("pad_size", PAD_SIZE)
        if isinstance(size, bool) or not isinstance(size, (int, float)):
            raise LayoutError(
                f"layout: pad_size is {size!r}; it must be a number in units of the half side"
            )
        return cls(str(data["name"]), data["positions"], data["normals"], size)


def _vectors(value: Any, what: str) -> np.ndarray:
    try:
        vectors = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise LayoutError(
            f"layout: {what} must be a list of [x, y, z] numbers; found {value!r}"
        ) from None
    if vectors.ndim != 2 or vectors.shape[1] != 3 or not np.all(np.isfinite(vectors)):
        raise LayoutError(
            f"layout: {what} must be a list of [x, y, z] finite numbers; "
            f"found shape {vectors.shape}"
        )
    return vectors


def _signed_axes(vector: np.ndarray) -> str:
    return "".join("-+"[int(c > 0)] + a for c, a in zip(vector, AXES, strict=True) if abs(c) > 1e-9)


def _section(sides: str, name: str, offset: float = PAD_OFFSET) -> Layout:
    """Layout from a text such as "+z-x +z+x": face and side of each pad."""

    def axis(text: str) -> np.ndarray:
        return (1.0 if text[0] == "+" else -1.0) * np.eye(3)[AXES.index(text[1])]

    normals = np.array([axis(pad[:2]) for pad in sides.split()])
    side = np.array([axis(pad[2:]) for pad in sides.split()])
    return Layout(name, normals + offset * side, normals)


_PLANAR = "+z-x +z+x -z-x -z+x +x-z +x+z -x-z -x+z"  # V1 .. V8 of the paper
_CYCLE = str.maketrans("xyz", "yzx")
_CUBE = " ".join([_PLANAR, _PLANAR.translate(_CYCLE), _PLANAR.translate(_CYCLE).translate(_CYCLE)])

# cube: the planar section in the planes z-x, x-y, y-z in this order, each from the last by x -> y
# -> z -> x
LAYOUTS: dict[str, Layout] = {
    "quad": _section(" ".join(_PLANAR.split()[:4]), "quad"),
    "planar": _section(_PLANAR, "planar"),
    "cube": _section(_CUBE, "cube"),
}


def find_layout(name: str) -> Layout:
    """A built-in layout by its name; LayoutError when there is none."""
    try:
        return LAYOUTS[name]
    except (KeyError, TypeError):
        raise LayoutError(f"unknown layout {name!r}; built in are {', '.join(LAYOUTS)}") from None
