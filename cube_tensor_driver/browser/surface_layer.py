"""What lies on the surface of a skin in the 3-D view: its field, and the cubes of a large skin.

It is one image if the surface is a plane, otherwise a cloud of points. Both are single objects,
which a computer without a graphics card can draw often.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core import scene
from ..core.scene import CubePoses

Array = NDArray[np.floating]

MOST_AREA_PER_POINT = 4
"""In squares of the points' spacing. Beyond it an image would be mostly empty."""
MOST_PIXELS = 25_000
"""To encode an image is half of what a picture of a large skin costs this process."""
MOST_PIXELS_PER_SIDE = 4
"""Of the square of one point."""
DARK = np.uint8(60)


class Raster:
    """An image in the plane of points: each pixel has the colour of the nearest point.

    points: (M, 3). frame: (3, 3) axes of the plane, z its normal. spacing: of the points. pixel:
    side of a pixel. cubes: cubes to paint as squares over the points; None: none.

    centre: (3,) of the image. owner: (rows, columns) whose colour a pixel has: the number of the
    point, or M + the number of the cube, or the next number where there is neither. The first row
    is at the greatest y.
    """

    def __init__(
        self,
        points: Array,
        frame: Array,
        spacing: float,
        pixel: float,
        cubes: CubePoses | None,
    ) -> None:
        in_plane = points @ frame
        low, high = in_plane.min(axis=0) - spacing / 2, in_plane.max(axis=0) + spacing / 2
        middle = (low + high) / 2
        self.centre = frame @ middle
        pixels = _pixel_centres(low, high, pixel)
        distance, self.owner = cKDTree(in_plane[:, :2]).query(pixels)
        nobody = len(points) + (0 if cubes is None else len(cubes.position))
        self.owner[distance > 0.75 * spacing] = nobody
        if cubes is not None:
            cube, inside = _cube_of_pixels(pixels, frame, cubes)
            self.owner[inside] = len(points) + cube[inside]

    def image(self, colours: Array) -> NDArray[np.uint8]:
        """(rows, columns, 4) bytes; colours: (M [+ cubes], 3) from 0 to 1.

        It is transparent where colours are NaN and where nothing is.
        """
        table = np.zeros((len(colours) + 1, 4), np.uint8)
        table[:-1, :3] = 255 * np.nan_to_num(colours)
        table[:-1, 3] = 255 * np.isfinite(colours[:, 0])
        # Words instead of rows of four bytes: a tenth of the time.
        pixels = table.view(np.uint32)[self.owner, 0]
        return pixels.view(np.uint8).reshape(*self.owner.shape, 4)


def _pixel_centres(low: Array, high: Array, pixel: float) -> Array:
    """(rows, columns, 2) x and y of the pixels that fill the rectangle from low to high."""
    columns, rows, _ = np.round((high - low) / pixel).astype(int)
    x = (np.arange(columns) - (columns - 1) / 2) * pixel
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel
    return np.stack(np.meshgrid(x, y), axis=2) + ((low + high) / 2)[:2]


def _cube_of_pixels(
    pixels: Array, frame: Array, cubes: CubePoses
) -> tuple[NDArray[np.integer], NDArray[np.bool_]]:
    """For pixels (rows, columns, 2): the nearest cube, and whether the pixel is inside it."""
    _, nearest = cKDTree((cubes.position @ frame)[:, :2]).query(pixels)
    flat = np.concatenate([pixels, np.zeros_like(pixels[..., :1])], axis=2)
    from_cube = flat @ frame.T - cubes.position[nearest]
    in_cube_frame = np.einsum("rcj,rcjk->rck", from_cube, cubes.rotation[nearest])
    inside = np.abs(in_cube_frame[..., :2]) < cubes.half_side[nearest, None]
    return nearest, inside.all(axis=2)


class SurfaceLayer:
    """Points (M, 3), `spacing` apart, at the lower faces of the cubes, in colours.

    rotation: (M, 3, 3) frames of the surface at the points. cubes: cubes to show in the layer;
    None: none.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        points: Array,
        rotation: Array,
        spacing: float,
        cubes: CubePoses | None,
    ) -> None:
        self._parts: list[FlatImage | PointCloud]
        if is_flat(points, rotation, spacing):
            self._parts = [FlatImage(api, points, rotation[0], spacing, cubes)]
            return
        # The diagonal: squares of neighbouring points touch, whatever way they face.
        self._parts = [PointCloud(api, "/field", points, np.sqrt(2) * spacing)]
        if cubes is not None:
            upper_faces = cubes.position + cubes.rotation[:, :, 2] * cubes.half_side[:, None]
            side = 2 * float(np.median(cubes.half_side))
            self._parts.append(PointCloud(api, "/cubes", upper_faces, side))

    def paint(self, colours: Array) -> None:
        """Colours (M [+ cubes], 3) from 0 to 1 of the points and the cubes; NaN hides them."""
        for part in self._parts:
            part.paint(colours[: part.count])
            colours = colours[part.count :]


class FlatImage:
    """The layer of a flat skin; count: how many colours it takes."""

    def __init__(
        self,
        api: viser.SceneApi,
        points: Array,
        frame: Array,
        spacing: float,
        cubes: CubePoses | None,
    ) -> None:
        self.count = len(points) + (0 if cubes is None else len(cubes.position))
        pixels_per_side, height = 1, 0.0
        if cubes is not None:
            # Squares need fine pixels, and lie where the upper faces would be.
            fine = np.sqrt(MOST_PIXELS / len(points))
            pixels_per_side = int(np.clip(fine, 1, MOST_PIXELS_PER_SIDE))
            height = 2 * float(np.median(cubes.half_side))
        pixel = spacing / pixels_per_side
        self._raster = Raster(points, frame, spacing, pixel, cubes)
        rows, columns = self._raster.owner.shape
        x, y, z = frame.T
        # Viser's images lie in the plane of x and -y.
        image_frame = np.stack([x, -y, -z], axis=1)
        self._image = api.add_image(
            "/field",
            np.zeros((rows, columns, 4), np.uint8),
            columns * pixel,
            rows * pixel,
            format="png",
            wxyz=scene.quaternions(image_frame[None])[0],
            position=self._raster.centre + height * z,
            cast_shadow=False,
            receive_shadow=False,
        )

    def paint(self, colours: Array) -> None:
        self._image.visible = bool(np.isfinite(colours).any())
        self._image.image = self._raster.image(colours)


class PointCloud:
    """Squares at points (N, 3) that face the viewer; count: N; side: of a square.

    The client makes a new material for new colours. A second cloud, which never changes, keeps the
    shader in use, so that it is not compiled again each time.
    """

    def __init__(self, api: viser.SceneApi, name: str, points: Array, side: float) -> None:
        self.count = len(points)
        self._node = self._add(api, name, points, side)
        self._add(api, f"{name}/kept", points[:2], 0.1 * side)

    @staticmethod
    def _add(api: viser.SceneApi, name: str, points: Array, side: float) -> viser.PointCloudHandle:
        return api.add_point_cloud(
            name,
            points,
            np.full(points.shape, DARK),
            point_size=side / 2,  # viser means half a side
            precision="float32",
            point_shading="flat",
        )

    def paint(self, colours: Array) -> None:
        self._node.visible = bool(np.isfinite(colours).any())
        self._node.colors = (255 * np.nan_to_num(colours)).astype(np.uint8)


def is_flat(points: Array, rotation: Array, spacing: float) -> bool:
    """Whether one image can show points (M, 3): they lie in a plane, close together.

    rotation: (M, 3, 3) frames of the points; the plane is normal to the z of all of them.
    """
    size = np.ptp(points @ rotation[0], axis=0) / spacing
    tilt = np.abs(rotation[:, :, 2] - rotation[0, :, 2]).max()
    area = (size[0] + 1) * (size[1] + 1)
    return bool(tilt < 1e-3 and size[2] < 0.1 and area < MOST_AREA_PER_POINT * len(points))
