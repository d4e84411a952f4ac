# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rows that arrive from the hubs of a large skin, of which only some are stored."""

from __future__ import annotations

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.demo.verification import Arrivals
from cube_tensor_driver.simulation.cubes import make_hub_cubes


class HubArrivals(Arrivals):
    """Stores only the rows of the first cube of each hub, which saves memory and time.

    The counts are the same if the rows of a hub's cubes at one sampling time either all arrive or
    are all lost.
    """

    def __init__(self, skin: Skin) -> None:
        super().__init__(skin)
        self.row_count[:] = 0
        for hub in make_hub_cubes(skin):
            members = hub.skin_cubes
            self.row_count[members[0]] = len(members)
