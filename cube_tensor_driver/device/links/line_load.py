"""Check whether the serial line of a link can carry what its cubes send."""

from __future__ import annotations

from collections.abc import Iterator

from ...config.port import TCP
from ...config.skin import Skin
from ..wire.protocol import sample_bytes

BITS_PER_BYTE = 10
"""Bits on the line for each byte: a start bit, eight data bits, a stop bit."""
PORTS_WITHOUT_BAUD = (TCP, "/dev/ttyACM")
"""First characters of ports that have no baud rate: TCP, and USB devices that are no adapters."""


def line_doubts(skin: Skin) -> Iterator[str]:
    """Yield one line for each link whose cubes send more than its baud rate allows.

    A skin that leaves the rate to its hubs cannot be checked.
    """
    if skin.rate is None:
        return
    for link in skin.links:
        cubes = [cube for cube in skin.cubes if cube.link == link.name]
        if not cubes or link.port.startswith(PORTS_WITHOUT_BAUD):
            continue
        # All cubes of a hub have the same number of pads.
        n_pads = cubes[0].calibration.layout.n_pads
        wanted = sample_bytes(len(cubes), n_pads) * skin.rate
        carried = link.baud / BITS_PER_BYTE
        if wanted > carried:
            yield (
                f"links: {link.name!r}: {len(cubes)} of the cubes at {skin.rate:g} Hz send "
                f"{wanted:.0f} bytes per second, {link.baud} baud carry {carried:.0f}: "
                "raise baud, lower rate, or use more links"
            )
