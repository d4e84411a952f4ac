# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Skin files for flat grids of cubes, as plain values for `write_yaml`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.errors import ConfigError

if TYPE_CHECKING:
    from .skin import CubeEntry, PoseEntry, SkinContent

MAX_CUBES = 1 << 16
"""Maximum number of cubes of a skin. Messages give the index of a cube as a 16-bit integer."""

DEFAULT_PITCH = 0.012
"""Distance of neighbouring cubes, in m, of a grid whose true distances are unknown or invented."""

LINK_NUMBER = "{}"
"""Placeholder in the text of a port, as in /dev/ttyACM{}, which is replaced by the number of the
link, from 0 up."""


def describe_grid(
    name: str = "skin",
    *,
    nx: int,
    ny: int,
    pitch: float = DEFAULT_PITCH,
    rate: float,
    links: int = 1,
    calibration: str | None = None,
    layout: str = "planar",
    port: str = "/dev/ttyACM{}",
) -> SkinContent:
    """Return the content of a skin file with nx × ny cubes in the x-y plane of the parent frame.

    The grid is centred on the origin of the frame. Cubes are numbered row by row: the x coordinate
    changes from one cube to the next, the y coordinate after every nx cubes.

    Args:
        name: Name of the skin.
        nx: Number of cubes along x.
        ny: Number of cubes along y.
        pitch: Distance between the centres of neighbouring cubes, in m.
        rate: Sampling rate of each cube, in Hz.
        links: Number of links. The cubes are divided among them in order, and the numbers of cubes
            of two links differ by at most one.
        calibration: Calibration of all cubes: a file, or the name of one in the package. None
            takes the calibration in the package that has the name of the layout.
        layout: Name of the layout of all cubes.
        port: Port of each link, where {} stands for the number of the link.

    Raises:
        ConfigError: There are more links than cubes, or more cubes than `MAX_CUBES`.
    """
    n_cubes = nx * ny
    if nx < 1 or not 1 <= links <= n_cubes <= MAX_CUBES:
        raise ConfigError(
            f"grid: {links} links for {nx} x {ny} cubes; allowed: 1 to {MAX_CUBES} cubes, and at "
            "least one cube per link"
        )

    # Names have leading zeros (c00, c01, ...), so that sorting them by text gives the same order as
    # sorting the cubes by number.
    digits = len(str(n_cubes - 1))
    cubes: list[CubeEntry] = []
    for number in range(n_cubes):
        # Integer division gives every link n_cubes / links cubes, rounded down or up.
        link = number * links // n_cubes
        first_of_link = -(-link * n_cubes // links)  # number of its first cube, rounded up
        x = (number % nx - (nx - 1) / 2) * pitch
        y = (number // nx - (ny - 1) / 2) * pitch
        pose: PoseEntry = {
            "xyz": [round(x, 9), round(y, 9), 0.0],
            "rpy": [0.0, 0.0, 0.0],
        }
        cube: CubeEntry = {
            "name": f"c{number:0{digits}d}",
            "link": f"hub{link}",
            "index": number - first_of_link,
            "pose": pose,
            "layout": layout,
            "calibration": calibration or layout,
        }
        cubes.append(cube)

    ports = [port.replace(LINK_NUMBER, str(link)) for link in range(links)]
    return {
        "name": name,
        "parent_frame": f"{name}_base",
        "rate": rate,
        "links": [{"name": f"hub{link}", "port": port} for link, port in enumerate(ports)],
        "cubes": cubes,
    }
