"""Squares of a skin in the 3-D view whose colours change: its field, and the cubes of a large skin.

The squares of one colour are one mesh. So a skin is a few objects, which a computer without a
graphics card can draw often. An image would be less to send, but a browser decodes images apart
from everything else: a slow one would show the field of another instant than the cubes.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from ..views import scene
from ..views.scene import Quantity
from .meshes import NOTHING, Mesh

Array = NDArray[np.floating]

STEPS = 32
"""Of the scale of colours. The next number is grey: unknown."""
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def steps_of(quantity: Quantity, shown: Array, top: float) -> NDArray[np.int64]:
    """(M,) the step of the scale for each value `shown`, SI; STEPS where it is NaN."""
    low = -top if quantity.signed else 0.0
    share = (np.nan_to_num(shown) - low) / (top - low)
    step = np.clip(share * STEPS, 0, STEPS - 1).astype(int)
    return np.where(np.isfinite(shown), step, STEPS)


def step_colours(quantity: Quantity) -> NDArray[np.uint8]:
    """(STEPS + 1, 3) bytes, sRGB: the colour of each step and of what is unknown."""
    middle = (np.arange(STEPS) + 0.5) / STEPS
    values = np.append(2 * middle - 1 if quantity.signed else middle, np.nan)
    return np.round(255 * scene.colours(quantity, values, 1.0)).astype(np.uint8)


class SquareLayer:
    """Squares of length `side` about points (M, 3).

    rotation: (M, 3, 3) their frames; the squares lie in x and y.
    """

    def __init__(
        self, api: viser.SceneApi, name: str, points: Array, rotation: Array, side: float
    ) -> None:
        corners = np.einsum("mij,qj->mqi", rotation[:, :, :2], side * _CORNERS)
        self._corners = (points[:, None] + corners).astype(np.float32)
        self._frame = api.add_frame(f"/{name}", show_axes=False)
        self._meshes = [
            api.add_mesh_simple(
                f"/{name}/{step}",
                *NOTHING,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            for step in range(STEPS + 1)
        ]
        self._drawn = np.zeros(STEPS + 1, bool)
        self._quantity: Quantity | None = None

    def hide(self) -> None:
        self._frame.visible = False

    def paint(self, quantity: Quantity, shown: Array, top: float) -> None:
        """Values `shown` (M,) of a quantity on the scale up to `top`, SI."""
        if quantity is not self._quantity:
            self._quantity = quantity
            for mesh, colour in zip(self._meshes, step_colours(quantity).tolist(), strict=True):
                mesh.color = tuple(colour)
        self._frame.visible = True
        steps = steps_of(quantity, shown, top)
        for step, mesh in enumerate(self._meshes):
            chosen = np.flatnonzero(steps == step)
            if len(chosen) or self._drawn[step]:
                mesh.vertices, mesh.faces = self._squares(chosen)
                self._drawn[step] = bool(len(chosen))

    def _squares(self, chosen: NDArray[np.int64]) -> Mesh:
        if not len(chosen):
            return NOTHING
        first = 4 * np.arange(len(chosen), dtype=np.uint32)
        faces = first[:, None, None] + _TRIANGLES.astype(np.uint32)
        return self._corners[chosen].reshape(-1, 3), faces.reshape(-1, 3)
