# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Images of values at scattered points, for views from above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.arrays import Array


class Raster:
    """An image of points in the x-y plane: each pixel has the colour of the nearest point.

    Attributes:
        low: (2,) corner of the image with the smallest x and y, in metres.
        high: (2,) corner of the image with the largest x and y, in metres.
        owner: (rows, columns) index of the point nearest to each pixel; the number of points M
            where no point is near enough, so that the pixel is transparent. The first row has the
            largest y.
    """

    def __init__(
        self,
        points: Array,
        pixel: float,
        reach: float,
    ) -> None:
        """Find the nearest point of each pixel.

        Args:
            points: (M, 3) positions of the points, in metres.
            pixel: Length of the side of a pixel, in metres.
            reach: Distance, in metres, to the nearest point above which a pixel is transparent.
        """
        flat = points[:, :2]
        low, high = flat.min(axis=0), flat.max(axis=0)
        # The margin around the outermost points is 0.7 times `reach`. The image is a little larger
        # than that, because it has whole pixels.
        extent = high - low + 1.4 * reach
        columns, rows = np.ceil(extent / pixel).astype(int)
        middle = (low + high) / 2
        half = np.array([columns, rows]) * pixel / 2
        self.low, self.high = middle - half, middle + half
        x = self.low[0] + (np.arange(columns) + 0.5) * pixel
        y = self.high[1] - (np.arange(rows) + 0.5) * pixel
        centres = np.stack(np.meshgrid(x, y), axis=2)
        distance, self.owner = cKDTree(flat).query(centres)
        # `image` appends a transparent colour at this index to the colours of the points.
        self.owner[distance > reach] = len(points)

    def image(self, colours: Array) -> NDArray[np.uint8]:
        """Return the pixels (rows, columns, 4) as red, green, blue and opacity from 0 to 255.

        Each pixel has the colour of the nearest point that was given at the construction.

        Args:
            colours: Colours (M, 3) of these M points, from 0 to 1; NaN is transparent.
        """
        table = np.zeros((len(colours) + 1, 4), np.uint8)
        table[:-1, :3] = np.round(255 * np.nan_to_num(colours))
        table[:-1, 3] = 255 * np.isfinite(colours[:, 0])
        return np.asarray(table[self.owner])
