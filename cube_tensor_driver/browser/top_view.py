"""The skin seen from above, as an SVG drawing: field as a heat map, cubes and contacts."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.arrays import Array
from ..core.poses import CubePoses
from ..touch.surface import Contact, Surface
from ..views import scene
from ..views.figures.style import png_of_pixels
from . import markup
from .colouring import Colouring
from .scene_3d import round_down

WIDTH = 400.0
"""Width of the SVG drawing, in its user units; the browser scales it to the width of the panel."""

MARGIN = 44.0
"""Space for numbers and labels at the left and lower edge, in user units of the SVG drawing."""

MAX_PIXELS_PER_SIDE = 256
"""Maximum number of pixels of the heat map along the longer side of the skin."""

MAX_NAMED_CUBES = 100
"""Maximum number of cubes of a skin whose names are written below the cubes."""

TICKS = 5
"""Approximate number of ticks (marks with a number) on the longer axis of the drawing."""


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
        extent = np.ptp(flat, axis=0) + 1.4 * reach
        columns, rows = np.ceil(extent / pixel).astype(int)
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
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

        Args:
            colours: (M, 3) colours of the points, from 0 to 1; NaN is transparent.
        """
        table = np.zeros((len(colours) + 1, 4), np.uint8)
        table[:-1, :3] = np.round(255 * np.nan_to_num(colours))
        table[:-1, 3] = 255 * np.isfinite(colours[:, 0])
        return np.asarray(table[self.owner])


class TopView:
    """Draws a skin, projected onto the x-y plane of its parent frame, as SVG."""

    def __init__(
        self,
        names: Sequence[str],
        poses: CubePoses,
        surface: Surface,
    ) -> None:
        self._names, self._poses = names, poses
        sides = np.ptp(surface.points[:, :2], axis=0)
        size = float(sides.max()) + surface.spacing
        pixel = max(size / MAX_PIXELS_PER_SIDE, surface.spacing / 4)
        self._raster = Raster(surface.points, pixel, 0.75 * surface.spacing)
        extent = self._raster.high - self._raster.low
        self._scale = (WIDTH - MARGIN) / float(extent[0])
        self._height = float(extent[1]) * self._scale
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        rotated = np.einsum("nij,qj->nqi", poses.rotation, square)
        self._corners = poses.position[:, None] + poses.half_side[:, None, None] * rotated
        # The axes are the same in all pictures, so they are drawn once.
        self._axes = self._draw_axes()

    def draw(
        self,
        colouring: Colouring,
        contacts: Sequence[Contact],
        chosen: int,
    ) -> str:
        """Return the drawing as an SVG element.

        Args:
            colouring: The values that are drawn as colours.
            contacts: The contacts to draw.
            chosen: Index of the chosen cube, which gets a thick outline.
        """
        parts = [
            self._heat_map(scene.colours(colouring.quantity, colouring.field, colouring.top)),
            self._axes,
            *self._cubes(colouring, chosen),
            *map(self._contact, contacts),
        ]
        height = self._height + MARGIN
        head = f"<svg viewBox='0 -8 {WIDTH + 8:g} {height + 8:.1f}' style='width:100%'"
        font = "font-family='sans-serif' font-size='10'"
        return f"{head} {font}>{''.join(parts)}</svg>"

    def _drawn(self, point: Array) -> tuple[float, float]:
        """Return the position of a point in the drawing: x and y in user units of the SVG element.

        Args:
            point: (2,) or (3,) coordinates in the parent frame of the skin, in metres.
        """
        x = MARGIN + (point[0] - self._raster.low[0]) * self._scale
        # The y axis of an SVG drawing points down, that of the parent frame up.
        y = (self._raster.high[1] - point[1]) * self._scale
        return float(x), float(y)

    def _heat_map(self, colours: Array) -> str:
        data = base64.b64encode(png_of_pixels(self._raster.image(colours))).decode()
        place = f"x='{MARGIN:g}' y='0' width='{WIDTH - MARGIN:g}' height='{self._height:.1f}'"
        return f"<image {place} preserveAspectRatio='none' href='data:image/png;base64,{data}'/>"

    def _draw_axes(self) -> str:
        """Return the frame of the drawing with ticks, numbers and labels in mm, as SVG."""
        low, high = 1e3 * self._raster.low, 1e3 * self._raster.high
        bottom = self._height
        parts = [
            f"<rect x='{MARGIN:g}' y='0' width='{WIDTH - MARGIN:g}' height='{bottom:.1f}' "
            "fill='none' stroke='#343a40'/>"
        ]
        step = round_down(float((high - low).max()) / TICKS)
        for tick in _ticks(low[0], high[0], step):
            x, _ = self._drawn(np.array([1e-3 * tick, 0.0]))
            parts.append(f"<path d='M{x:.1f} {bottom:.1f}v4' stroke='#343a40'/>")
            parts.append(_text(x, bottom + 15, f"{tick:g}"))
        for tick in _ticks(low[1], high[1], step):
            _, y = self._drawn(np.array([0.0, 1e-3 * tick]))
            parts.append(f"<path d='M{MARGIN:g} {y:.1f}h-4' stroke='#343a40'/>")
            parts.append(_text(MARGIN - 6, y + 3, f"{tick:g}", "end"))
        parts.append(_text((MARGIN + WIDTH) / 2, bottom + 30, "x / mm"))
        rotated = f"transform='rotate(-90 10 {bottom / 2:.1f})'"
        parts.append(f"<g {rotated}>{_text(10, bottom / 2, 'y / mm')}</g>")
        return "".join(parts)

    def _cubes(self, colouring: Colouring, chosen: int) -> list[str]:
        """Return SVG polygons of the cubes in their colours, with tool tips.

        In a skin of up to `MAX_NAMED_CUBES` cubes, the name of each cube stands below it.

        Args:
            colouring: The values that are drawn as colours.
            chosen: Index of the chosen cube, which gets a thick outline.
        """
        colours = scene.colours(colouring.quantity, colouring.cubes, colouring.top)
        rgb = (255 * colours).astype(int)
        parts = []
        for cube, (name, corners) in enumerate(zip(self._names, self._corners, strict=True)):
            points = " ".join("{:.1f},{:.1f}".format(*self._drawn(corner)) for corner in corners)
            # The thick outline marks the chosen cube, whose numbers the page shows.
            width = 2.5 if cube == chosen else 0.7
            title = escape(f"{name}: {colouring.text(cube)}")
            parts.append(
                f"<polygon points='{points}' fill='rgb({','.join(map(str, rgb[cube]))})' "
                f"stroke='#212529' stroke-width='{width}'><title>{title}</title></polygon>"
            )
            if len(self._names) <= MAX_NAMED_CUBES:
                x, y = self._drawn(corners.mean(axis=0))
                half = self._poses.half_side[cube] * self._scale
                parts.append(_text(x, y + half + 10, escape(name)))
        return parts

    def _contact(self, contact: Contact) -> str:
        """Return SVG of a contact: a circle around its position, and its forces as text.

        The circle has the area of the contact.
        """
        x, y = self._drawn(contact.position)
        radius = max(3.0, np.sqrt(contact.area / np.pi) * self._scale)
        circle = f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{radius:.1f}'"
        parts = [f"{circle} fill='none' stroke='#1864ab' stroke-width='2'/>"]
        parts.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='2.5' fill='#1864ab'/>")
        # The text stands above the circle, but below it if the upper edge would cut it off.
        has_room_above = y - radius - 6 > 8
        text_y = y - radius - 6 if has_room_above else y + radius + 14
        text_x = min(max(x, MARGIN + 60), WIDTH - 60)
        halo = "paint-order='stroke' stroke='white' stroke-width='3' font-weight='bold'"
        text = _text(text_x, text_y, markup.newtons(contact))
        return "".join(parts) + f"<g {halo}>{text}</g>"


def _text(
    x: float,
    y: float,
    text: str,
    anchor: str = "middle",
) -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}'>{text}</text>"


def _ticks(low: float, high: float, step: float) -> list[float]:
    """Return the numbers on an axis: all multiples of `step` from `low` to `high`.

    They are rounded to six significant digits.
    """
    first, last = np.ceil(low / step), np.floor(high / step)
    numbers = np.arange(first, last + 1)
    return [float(f"{number * step:.6g}") for number in numbers]
