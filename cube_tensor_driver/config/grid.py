"""Skin files for flat grids of cubes, as plain values for `write_yaml`."""

from __future__ import annotations

from typing import Any

from ..core.errors import ConfigError

MOST_CUBES = 1 << 16
"""Messages number cubes with 16 bits."""
PLACE = "{}"
"""In a port, for the number of the link."""


def grid(
    name: str = "skin",
    *,
    nx: int,
    ny: int,
    pitch: float,
    rate: float,
    links: int = 1,
    calibration: str | None = None,
    layout: str = "planar",
    port: str = "/dev/ttyACM{}",
) -> dict[str, Any]:
    """The content of a skin file with nx × ny cubes in the x-y plane of the parent frame.

    The grid is centred on the frame's origin; x runs fastest. pitch: distance of neighbours, m.
    rate: samples per second. The links carry equally many cubes, or one more, in order. port: the
    port of each link, where {} stands for the number of the link. calibration: file or name;
    None: that of the package for the layout.

    Raises ConfigError if a number is not greater than 0, if there are more links than cubes or
    more cubes than messages can number, or if all links would have one port.
    """
    numbers = {"nx": nx, "ny": ny, "pitch": pitch, "links": links, "rate": rate}
    for what, value in numbers.items():
        if value <= 0:
            raise ConfigError(f"grid: {what} is {value}, must be greater than 0")
    count = nx * ny
    if links > count:
        raise ConfigError(f"grid: {links} links for {count} cubes; use at most one link per cube")

    if count > MOST_CUBES:
        raise ConfigError(
            f"grid: {nx} x {ny} are {count} cubes, a skin has at most {MOST_CUBES}: "
            "make several skins"
        )
    if links > 1 and PLACE not in port:
        raise ConfigError(
            f"grid: the port {port!r} is that of all {links} links; write {PLACE} where the number "
            "of the link belongs"
        )

    digits = len(str(count - 1))
    cubes = []
    for number in range(count):
        link = number * links // count
        first_of_link = -(-link * count // links)
        x = (number % nx - (nx - 1) / 2) * pitch
        y = (number // nx - (ny - 1) / 2) * pitch
        cubes.append(
            {
                "name": f"c{number:0{digits}d}",
                "link": f"hub{link}",
                "index": number - first_of_link,
                "pose": {"xyz": [round(x, 9), round(y, 9), 0.0], "rpy": [0.0, 0.0, 0.0]},
                "layout": layout,
                "calibration": calibration or layout,
            }
        )
    return {
        "name": name,
        "parent_frame": f"{name}_base",
        "rate": rate,
        "links": [
            {"name": f"hub{link}", "port": port.replace(PLACE, str(link))} for link in range(links)
        ],
        "cubes": cubes,
    }
