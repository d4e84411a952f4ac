"""The skin seen from above, in two dimensions: its field as a heat map, its cubes and contacts."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.poses import CubePoses
from ..touch.surface import Contact, Surface
from ..views import scene
from ..views.figures.style import png_of_pixels
from . import markup
from .scene_3d import Colouring, round_down

Array = NDArray[np.floating]

WIDTH, MARGIN = 400.0, 44.0
"""Of the drawing, and of its axes' numbers, in units of the drawing."""
MOST_PIXELS_PER_SIDE = 256
MOST_NAMES = 100
TICKS = 5
"""About so many on an axis."""


class Raster:
    """An image of points seen along z: each pixel has the colour of the nearest point.

    points: (M, 3). pixel: its side. reach: pixels further from every point are transparent.

    low, high: (2,) corners of the image. owner: (rows, columns) number of the point whose colour a
    pixel has, or M. The first row is at the greatest y.
    """

    def __init__(self, points: Array, pixel: float, reach: float) -> None:
        flat = points[:, :2]
        columns, rows = np.ceil((np.ptp(flat, axis=0) + 1.4 * reach) / pixel).astype(int)
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
        half = np.array([columns, rows]) * pixel / 2
        self.low, self.high = middle - half, middle + half
        x = self.low[0] + (np.arange(columns) + 0.5) * pixel
        y = self.high[1] - (np.arange(rows) + 0.5) * pixel
        distance, self.owner = cKDTree(flat).query(np.stack(np.meshgrid(x, y), axis=2))
        self.owner[distance > reach] = len(points)

    def image(self, colours: Array) -> NDArray[np.uint8]:
        """(rows, columns, 4) bytes; colours: (M, 3) from 0 to 1, NaN is transparent."""
        table = np.zeros((len(colours) + 1, 4), np.uint8)
        table[:-1, :3] = np.round(255 * np.nan_to_num(colours))
        table[:-1, 3] = 255 * np.isfinite(colours[:, 0])
        return table[self.owner]


class TopView:
    """Draws the skin in the x-y plane of its parent frame as an SVG."""

    def __init__(self, names: Sequence[str], poses: CubePoses, surface: Surface) -> None:
        self._names, self._poses = names, poses
        size = float(np.ptp(surface.points[:, :2], axis=0).max()) + surface.spacing
        pixel = max(size / MOST_PIXELS_PER_SIDE, surface.spacing / 4)
        self._raster = Raster(surface.points, pixel, 0.75 * surface.spacing)
        low, high = self._raster.low, self._raster.high
        self._scale = (WIDTH - MARGIN) / float((high - low)[0])
        self._height = float((high - low)[1]) * self._scale
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        turned = np.einsum("nij,qj->nqi", poses.rotation, corners)
        self._corners = poses.position[:, None] + poses.half_side[:, None, None] * turned
        self._axes = self._draw_axes()

    def draw(self, colouring: Colouring, contacts: Sequence[Contact], chosen: int) -> str:
        """An SVG element."""
        quantity, top = colouring.quantity, colouring.top
        parts = [
            self._heat_map(scene.colours(quantity, colouring.field, top)),
            self._axes,
            *self._cubes(colouring, chosen),
            *(self._contact(contact) for contact in contacts),
        ]
        height = self._height + MARGIN
        head = f"<svg viewBox='0 -8 {WIDTH + 8:g} {height + 8:.1f}' style='width:100%'"
        font = "font-family='sans-serif' font-size='10'"
        return f"{head} {font}>{''.join(parts)}</svg>"

    def _at(self, point: Array) -> tuple[float, float]:
        """Of a point in m, in the drawing."""
        x = MARGIN + (point[0] - self._raster.low[0]) * self._scale
        return float(x), float((self._raster.high[1] - point[1]) * self._scale)

    def _heat_map(self, colours: Array) -> str:
        data = base64.b64encode(png_of_pixels(self._raster.image(colours))).decode()
        place = f"x='{MARGIN:g}' y='0' width='{WIDTH - MARGIN:g}' height='{self._height:.1f}'"
        return f"<image {place} preserveAspectRatio='none' href='data:image/png;base64,{data}'/>"

    def _draw_axes(self) -> str:
        """Frame, ticks and labels, in mm."""
        low, high = 1e3 * self._raster.low, 1e3 * self._raster.high
        bottom = self._height
        parts = [
            f"<rect x='{MARGIN:g}' y='0' width='{WIDTH - MARGIN:g}' height='{bottom:.1f}' "
            "fill='none' stroke='#343a40'/>"
        ]
        step = round_down(float((high - low).max()) / TICKS)
        for tick in _ticks(low[0], high[0], step):
            x, _ = self._at(np.array([1e-3 * tick, 0.0]))
            parts.append(f"<path d='M{x:.1f} {bottom:.1f}v4' stroke='#343a40'/>")
            parts.append(_text(x, bottom + 15, f"{tick:g}"))
        for tick in _ticks(low[1], high[1], step):
            _, y = self._at(np.array([0.0, 1e-3 * tick]))
            parts.append(f"<path d='M{MARGIN:g} {y:.1f}h-4' stroke='#343a40'/>")
            parts.append(_text(MARGIN - 6, y + 3, f"{tick:g}", "end"))
        parts.append(_text((MARGIN + WIDTH) / 2, bottom + 30, "x / mm"))
        turn = f"transform='rotate(-90 10 {bottom / 2:.1f})'"
        parts.append(f"<g {turn}>{_text(10, bottom / 2, 'y / mm')}</g>")
        return "".join(parts)

    def _cubes(self, colouring: Colouring, chosen: int) -> list[str]:
        colours = (255 * scene.colours(colouring.quantity, colouring.cubes, colouring.top)).astype(
            int
        )
        parts = []
        for cube, (name, corners) in enumerate(zip(self._names, self._corners, strict=True)):
            points = " ".join("{:.1f},{:.1f}".format(*self._at(corner)) for corner in corners)
            width = 2.5 if cube == chosen else 0.7
            title = escape(f"{name}: {colouring.text(cube)}")
            parts.append(
                f"<polygon points='{points}' fill='rgb({','.join(map(str, colours[cube]))})' "
                f"stroke='#212529' stroke-width='{width}'><title>{title}</title></polygon>"
            )
            if len(self._names) <= MOST_NAMES:
                x, y = self._at(corners.mean(axis=0))
                half = self._poses.half_side[cube] * self._scale
                parts.append(_text(x, y + half + 10, escape(name)))
        return parts

    def _contact(self, contact: Contact) -> str:
        """A circle of the contact's area, its forces, and a line along its shear force."""
        x, y = self._at(contact.position)
        radius = max(3.0, np.sqrt(contact.area / np.pi) * self._scale)
        circle = f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{radius:.1f}'"
        parts = [f"{circle} fill='none' stroke='#1864ab' stroke-width='2'/>"]
        parts.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='2.5' fill='#1864ab'/>")
        above = y - radius - 6 > 8
        text_y = y - radius - 6 if above else y + radius + 14
        halo = "paint-order='stroke' stroke='white' stroke-width='3' font-weight='bold'"
        text = _text(min(max(x, MARGIN + 60), WIDTH - 60), text_y, markup.newtons(contact))
        return "".join(parts) + f"<g {halo}>{text}</g>"


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}'>{text}</text>"


def _ticks(low: float, high: float, step: float) -> list[float]:
    numbers = np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    return [float(f"{number * step:.6g}") for number in numbers]
