# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The skin seen from above, as an SVG drawing: field as a heat map, cubes and contacts."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np

from ..core.arrays import Array
from ..core.poses import CubePoses
from ..touch.surface import Contact, Surface
from ..views.figures.style import png_of_pixels
from ..views.raster import Raster
from ..views.round_numbers import round_down, round_ticks
from . import markup
from .colouring import Colouring

WIDTH = 400.0
"""Width of the SVG drawing, in its user units; the browser scales it to the width of the panel."""

MARGIN = 44.0
"""Space for numbers and labels at the left and lower edge, in user units of the SVG drawing."""

MAX_PIXELS_PER_SIDE = 256
"""Maximum number of pixels of the heat map along the longer side of the skin."""

MAX_NAMED_CUBES = 100
"""Maximum number of cubes of a skin whose names are written below the cubes.

In a larger skin, cubes have tool tips only while the page is paused.
"""

TICKS = 5
"""Approximate number of ticks (marks with a number) on the longer axis of the drawing."""


class TopView:
    """Draws a skin, projected onto the x-y plane of its parent frame, as SVG."""

    def __init__(
        self,
        names: Sequence[str],
        poses: CubePoses,
        surface: Surface,
    ) -> None:
        self._names = [escape(name) for name in names]
        sides = np.ptp(surface.points[:, :2], axis=0)
        size = float(sides.max()) + surface.spacing
        pixel = max(size / MAX_PIXELS_PER_SIDE, surface.spacing / 4)
        self._raster = Raster(
            surface.points,
            pixel,
            0.75 * surface.spacing,
        )
        extent = self._raster.high - self._raster.low
        self._scale = (WIDTH - MARGIN) / float(extent[0])
        self._height = float(extent[1]) * self._scale
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        rotated = np.einsum("nij,qj->nqi", poses.rotation, square)
        corners = poses.position[:, None] + poses.half_side[:, None, None] * rotated
        # Outlines, names and axes are the same in all pictures, so they are drawn once.
        self._outlines = [
            " ".join("{:.1f},{:.1f}".format(*self._drawn(corner)) for corner in square)
            for square in corners
        ]
        self._fixed = self._draw_axes() + self._draw_names(poses)

    def draw(
        self,
        colouring: Colouring,
        contacts: Sequence[Contact],
        chosen: int,
        with_texts: bool,
    ) -> str:
        """Return the drawing as an SVG element.

        Args:
            colouring: The values that are drawn as colours.
            contacts: The contacts to draw.
            chosen: Index of the chosen cube, which gets a thick outline.
            with_texts: Whether cubes have tool tips even if there are more than
                `MAX_NAMED_CUBES`. Drawing and sending tool tips takes longer than all the rest.
        """
        parts = [
            self._heat_map(colouring.colours(colouring.field)),
            self._fixed,
            self._cubes(colouring, chosen, with_texts or len(self._names) <= MAX_NAMED_CUBES),
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
        for tick in round_ticks(low[0], high[0], step):
            x, _ = self._drawn(np.array([1e-3 * tick, 0.0]))
            parts.append(f"<path d='M{x:.1f} {bottom:.1f}v4' stroke='#343a40'/>")
            parts.append(_text(x, bottom + 15, f"{tick:g}"))
        for tick in round_ticks(low[1], high[1], step):
            _, y = self._drawn(np.array([0.0, 1e-3 * tick]))
            parts.append(f"<path d='M{MARGIN:g} {y:.1f}h-4' stroke='#343a40'/>")
            parts.append(_text(MARGIN - 6, y + 3, f"{tick:g}", "end"))
        parts.append(_text((MARGIN + WIDTH) / 2, bottom + 30, "x / mm"))
        rotated = f"transform='rotate(-90 10 {bottom / 2:.1f})'"
        parts.append(f"<g {rotated}>{_text(10, bottom / 2, 'y / mm')}</g>")
        return "".join(parts)

    def _draw_names(self, poses: CubePoses) -> str:
        """Return the names below the cubes as SVG; none in a skin above `MAX_NAMED_CUBES`."""
        if len(self._names) > MAX_NAMED_CUBES:
            return ""
        parts = []
        for name, position, half_side in zip(self._names, *poses[::2], strict=True):
            x, y = self._drawn(position)
            parts.append(_text(x, y + half_side * self._scale + 10, name))
        return "".join(parts)

    def _cubes(
        self,
        colouring: Colouring,
        chosen: int,
        with_texts: bool,
    ) -> str:
        """Return SVG polygons of the cubes in their colours.

        Args:
            colouring: The values that are drawn as colours.
            chosen: Index of the chosen cube, which gets a thick outline.
            with_texts: Whether each cube has a tool tip with its name and value.
        """
        rgb = (255 * colouring.colours(colouring.cubes)).astype(np.uint8)
        digits = rgb.tobytes().hex()
        polygons = []
        for cube, outline in enumerate(self._outlines):
            colour = digits[6 * cube : 6 * cube + 6]
            text = f"{self._names[cube]}: {colouring.text(cube)}" if with_texts else ""
            title = f"<title>{text}</title>"
            polygons.append(f"<polygon points='{outline}' fill='#{colour}'>{title}</polygon>")
        mark = f"<polygon points='{self._outlines[chosen]}' fill='none' stroke-width='2.5'/>"
        return f"<g stroke='#212529' stroke-width='0.7'>{''.join(polygons)}{mark}</g>"

    def _contact(self, contact: Contact) -> str:
        """Return SVG of a contact: a circle around its position, and its forces as text.

        The circle has the area of the contact.
        """
        x, y = self._drawn(contact.position)
        radius = max(3.0, np.sqrt(contact.area / np.pi) * self._scale)
        circle = f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{radius:.1f}'"
        parts = [f"{circle} fill='none' stroke='#c828a0' stroke-width='2'/>"]
        parts.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='2.5' fill='#c828a0'/>")
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
