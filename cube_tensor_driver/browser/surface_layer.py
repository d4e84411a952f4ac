"""What lies on a skin's surface in the 3-D view: its field, and the cubes of a large skin. One
image where all of it is
plane, elsewhere a cloud of points: single objects, which a machine without a graphics card can draw
often."""

from __future__ import annotations

import sys

import numpy as np
import viser
from scipy.spatial import cKDTree

from ..core import scene
from ..core.scene import CubePoses

# Viser looks for OpenCV anew for each image, which costs more than the image where there is none.
sys.modules.setdefault("cv2", None)  # type: ignore[arg-type]

EMPTY = 4
"""Most pixels per point: an image of cubes far apart would be mostly of nothing."""
MOST_PIXELS = 25_000
"""Of an image: encoding it is half of what a picture of a large skin costs the view."""
DARK = np.uint8(60)


class Raster:
    """Pixels of side `pixel` in the plane of points (M, 3), each of its nearest point, or of the
    cube that it is in.

    turn (3, 3): the plane's frame, z its normal; spacing: of the points; cubes: to paint, None:
    none. owner (rows,
    columns): the point, M + the cube, one more where nothing is; the first row is at the greatest
    y. centre (3,).
    """

    def __init__(
        self,
        points: np.ndarray,
        turn: np.ndarray,
        spacing: float,
        pixel: float,
        cubes: CubePoses | None,
    ) -> None:
        flat = points @ turn
        low, high = flat.min(axis=0) - spacing / 2, flat.max(axis=0) + spacing / 2
        columns, rows, _ = np.round((high - low) / pixel).astype(int)
        self.centre = turn @ ((low + high) / 2)
        across = (np.arange(columns) - (columns - 1) / 2) * pixel
        up = ((rows - 1) / 2 - np.arange(rows)) * pixel
        pixels = np.stack(np.meshgrid(across, up), axis=2) + (low + high)[:2] / 2
        apart, self.owner = cKDTree(flat[:, :2]).query(pixels)
        count = len(points) if cubes is None else len(points) + len(cubes.position)
        self.owner[apart > 0.75 * spacing] = count
        if cubes is not None:
            _, near = cKDTree((cubes.position @ turn)[:, :2]).query(pixels)
            places = np.concatenate([pixels, np.zeros_like(pixels[..., :1])], axis=2) @ turn.T
            within = np.einsum(
                "rcj,rcjk->rck", places - cubes.position[near], cubes.rotation[near]
            )[..., :2]
            inside = (np.abs(within) < cubes.half_side[near, None]).all(axis=2)
            self.owner[inside] = len(points) + near[inside]

    def image(self, colours: np.ndarray) -> np.ndarray:
        """(rows, columns, 4) bytes of colours (M [+ cubes], 3) from 0 to 1; transparent where
        nothing is or NaN."""
        table = np.zeros((len(colours) + 1, 4), np.uint8)
        table[:-1, :3] = 255 * np.nan_to_num(colours)
        table[:-1, 3] = 255 * np.isfinite(colours[:, 0])
        return table.view(np.uint32)[self.owner, 0].view(np.uint8).reshape(*self.owner.shape, 4)


class SurfaceLayer:
    """Points (M, 3) at the cubes' lower faces, `spacing` apart, with the frames (M, 3, 3) that they
    lie in; cubes: to
    show there, None: none."""

    def __init__(
        self,
        to: viser.SceneApi,
        points: np.ndarray,
        rotation: np.ndarray,
        spacing: float,
        cubes: CubePoses | None,
    ) -> None:
        self._clouds: list[Cloud] = []
        if is_flat(points, rotation, spacing):
            fine = 1 if cubes is None else int(np.clip(np.sqrt(MOST_PIXELS / len(points)), 1, 4))
            self._raster = Raster(points, rotation[0], spacing, spacing / fine, cubes)
            rows, columns = self._raster.owner.shape
            x, y, z = rotation[0].T
            # Cubes that are painted lie where their upper faces would be.
            place = (
                self._raster.centre
                + (0 if cubes is None else 2 * float(np.median(cubes.half_side))) * z
            )
            # Viser's images lie in x and −y.
            (turn,) = scene.turns(np.stack([x, -y, -z], axis=1)[None])
            self._image = to.add_image(
                "/field",
                np.zeros((rows, columns, 4), np.uint8),
                columns * spacing / fine,
                rows * spacing / fine,
                format="png",
                wxyz=turn,
                position=place,
                cast_shadow=False,
                receive_shadow=False,
            )
        else:
            # Squares that touch at their corners, too, however they are turned.
            self._clouds.append(Cloud(to, "/field", points, np.sqrt(2) * spacing))
            if cubes is not None:
                top = cubes.position + cubes.rotation[:, :, 2] * cubes.half_side[:, None]
                self._clouds.append(Cloud(to, "/cubes", top, 2 * float(np.median(cubes.half_side))))

    def paint(self, colours: np.ndarray) -> None:
        """Colours (M [+ cubes], 3) from 0 to 1 of the points and the cubes; NaN: not to be seen."""
        if not self._clouds:
            self._image.visible = bool(np.isfinite(colours).any())
            self._image.image = self._raster.image(colours)
        for cloud in self._clouds:
            cloud.paint(colours[: cloud.count])
            colours = colours[cloud.count :]


class Cloud:
    """Squares of side `size` at points (N, 3) that face the viewer. The client makes a new material
    for new colours; a part of it that never changes keeps its shader from being compiled anew each
    time. Viser's size is half a side."""

    def __init__(self, to: viser.SceneApi, name: str, points: np.ndarray, size: float) -> None:
        self.count = len(points)
        self._node, _ = (
            to.add_point_cloud(
                path,
                some,
                np.full(some.shape, DARK),
                point_size=side / 2,
                precision="float32",
                point_shading="flat",
            )
            for path, some, side in ((name, points, size), (f"{name}/kept", points[:2], 0.1 * size))
        )

    def paint(self, colours: np.ndarray) -> None:
        self._node.visible = bool(np.isfinite(colours).any())
        self._node.colors = (255 * np.nan_to_num(colours)).astype(np.uint8)


def is_flat(points: np.ndarray, rotation: np.ndarray, spacing: float) -> bool:
    """Whether points (M, 3) lie in one plane, normal to the z of all their frames, close enough for
    one image."""
    size = np.ptp(points @ rotation[0], axis=0) / spacing
    turned = np.abs(rotation[:, :, 2] - rotation[0, :, 2]).max()
    return bool(
        turned < 1e-3 and size[2] < 0.1 and (size[0] + 1) * (size[1] + 1) < EMPTY * len(points)
    )
