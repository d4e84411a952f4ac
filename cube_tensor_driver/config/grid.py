"""Skin files of flat grids of cubes, as plain values for `write_yaml`."""

from __future__ import annotations

from typing import Any

from ..core.errors import ConfigError


def grid(
    name: str,
    nx: int,
    ny: int,
    pitch: float,
    links: int,
    calibration: str,
    layout: str,
    rate: float,
    port: str,
) -> dict[str, Any]:
    """A skin of nx × ny cubes in the parent frame's x-y plane, centred on it, pitch in m, x running
    fastest.

    The cubes are dealt to the links in order, as evenly as possible. port: pattern of the links'
    ports, {} the link's number. ConfigError: a number that is not positive, or more links than
    cubes.
    """
    for what, value in {"nx": nx, "ny": ny, "pitch": pitch, "links": links, "rate": rate}.items():
        if value <= 0:
            raise ConfigError(f"grid: {what} is {value}, must be greater than 0")
    count = nx * ny
    if links > count:
        raise ConfigError(f"grid: {links} links for {count} cubes; use at most one link per cube")
    digits = len(str(count - 1))
    cubes = []
    for number in range(count):
        link = number * links // count
        first = -(-link * count // links)
        x, y = ((number % nx) - (nx - 1) / 2) * pitch, ((number // nx) - (ny - 1) / 2) * pitch
        cubes.append(
            {
                "name": f"c{number:0{digits}d}",
                "link": f"hub{link}",
                "index": number - first,
                "pose": {"xyz": [round(x, 9), round(y, 9), 0.0], "rpy": [0.0, 0.0, 0.0]},
                "layout": layout,
                "calibration": calibration,
            }
        )
    return {
        "name": name,
        "parent_frame": f"{name}_base",
        "rate": rate,
        "links": [{"name": f"hub{link}", "port": port.format(link)} for link in range(links)],
        "cubes": cubes,
    }
