"""The field on a skin's surface in the 3-D view: one image where all of it is plane, elsewhere a tile per point."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import viser
from scipy.spatial import cKDTree

from ..core import scene

# Viser looks for OpenCV anew for each image, which costs more than the image where there is none.
sys.modules.setdefault("cv2", None)  # type: ignore[arg-type]

EMPTY = 4
"""Most pixels per point: an image of cubes far apart would be mostly of nothing."""
TILE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
TILE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
PLAIN: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


class Raster:
    """Pixels of side `spacing` in the plane of points (M, 3), each with its nearest point's colour.

    turn (3, 3): the plane's frame, z its normal. owner (rows, columns): point of each pixel, the first row at the
    greatest y; seen: whether a point is there; centre (3,).
    """

    def __init__(self, points: np.ndarray, turn: np.ndarray, spacing: float) -> None:
        flat = points @ turn
        low, high = flat.min(axis=0), flat.max(axis=0)
        columns, rows, _ = np.round((high - low) / spacing).astype(int) + 1
        self.centre = turn @ ((low + high) / 2)
        across = (np.arange(columns) - (columns - 1) / 2) * spacing
        up = ((rows - 1) / 2 - np.arange(rows)) * spacing
        pixels = np.stack(np.meshgrid(across, up), axis=2) + (low + high)[:2] / 2
        apart, self.owner = cKDTree(flat[:, :2]).query(pixels)
        self.seen = apart < 0.75 * spacing

    def image(self, colours: np.ndarray) -> np.ndarray:
        """(rows, columns, 4) bytes of colours (M, 3) from 0 to 1; transparent where no point is."""
        return np.dstack([(255 * colours[self.owner]).astype(np.uint8), np.where(self.seen, np.uint8(255), 0)])


class Carpet:
    """Points (M, 3) with the frames (M, 3, 3) that they lie in, and the colour of each."""

    def __init__(self, to: viser.SceneApi, points: np.ndarray, rotation: np.ndarray, spacing: float) -> None:
        self._raster: Raster | None = None
        self.node: Any
        if is_flat(points, rotation, spacing):
            self._raster = Raster(points, rotation[0], spacing)
            rows, columns = self._raster.owner.shape
            x, y, z = rotation[0].T
            # Viser's images lie in x and −y.
            (turn,) = scene.turns(np.stack([x, -y, -z], axis=1)[None])
            grey = self._raster.image(np.full((len(points), 3), 0.2))
            self.node = to.add_image("/field", grey, columns * spacing, rows * spacing, format="png", wxyz=turn,
                                     position=self._raster.centre, **PLAIN)  # fmt: skip
        else:
            grey = np.full((len(points), 3), 60, np.uint8)
            self.node = to.add_batched_meshes_simple(
                "/field", TILE * spacing, TILE_FACES, scene.turns(rotation), points, batched_colors=grey, side="double",
                lod="off", **PLAIN)  # fmt: skip

    def paint(self, colours: np.ndarray) -> None:
        """Colours (M, 3) from 0 to 1."""
        if self._raster is None:
            self.node.batched_colors = light(colours)
        else:
            self.node.image = self._raster.image(colours)


def is_flat(points: np.ndarray, rotation: np.ndarray, spacing: float) -> bool:
    """Whether points (M, 3) lie in one plane, normal to the z of all their frames, close enough for one image."""
    size = np.ptp(points @ rotation[0], axis=0) / spacing
    turned = np.abs(rotation[:, :, 2] - rotation[0, :, 2]).max()
    return bool(turned < 1e-3 and size[2] < 0.1 and (size[0] + 1) * (size[1] + 1) < EMPTY * len(points))


def light(colours: np.ndarray) -> np.ndarray:
    """Colours of batched meshes: the client takes them as amounts of light, not as sRGB."""
    return (255 * np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)).astype(np.uint8)
