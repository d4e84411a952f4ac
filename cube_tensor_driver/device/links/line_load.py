# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check whether the baud rate of a serial line suffices for the samples of its cubes."""

from __future__ import annotations

from collections.abc import Iterator

from ...config.port import TCP
from ...config.skin import Skin
from ..wire.protocol import count_sample_bytes

BITS_PER_BYTE = 10
"""Number of bits on a serial line for each byte: a start bit, eight data bits, a stop bit."""
PORTS_WITHOUT_BAUD = (TCP, "/dev/ttyACM")
"""Beginnings of the names of ports whose baud rate has no effect: TCP addresses, and hubs that are
USB devices themselves (not a serial line behind a USB adapter)."""


def find_slow_lines(skin: Skin) -> Iterator[str]:
    """Yield one warning for each serial line that is too slow for the samples of its cubes.

    There is no warning if the skin file sets no sample rate, because the hubs' own is unknown.

    Args:
        skin: The skin: its cubes, links and sample rate, as read from the skin file.
    """
    if skin.rate is None:
        return
    for link in skin.links:
        cubes = [cube for cube in skin.cubes if cube.link == link.name]
        if not cubes or link.port.startswith(PORTS_WITHOUT_BAUD):
            continue
        # All cubes of a hub have the same number of pads, so that of the first one is enough.
        n_pads = cubes[0].calibration.layout.n_pads
        wanted = count_sample_bytes(len(cubes), n_pads) * skin.rate
        carried = link.baud / BITS_PER_BYTE
        if wanted > carried:
            yield (
                f"links: {link.name!r}: {len(cubes)} of the cubes at {skin.rate:g} Hz send "
                f"{wanted:.0f} bytes per second, {link.baud} baud carry {carried:.0f}: "
                "raise baud, lower rate, or use more links"
            )
