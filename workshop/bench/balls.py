# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Load script of four balls that begin, move over a skin and end."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cube_tensor_driver.config.yaml import write_yaml

from .hubs_in_c import DEPTH

PERIOD_S = 3.0
"""Time, in s, after which the balls begin again."""

MOVING_S = 2.0
"""Time, in s, in which each ball goes once around its circle, with a mean speed of 38 mm/s."""

DELAY_S = 0.25
"""Time, in s, from the start of one ball to that of the next one."""

CIRCLE_RADIUS_M = 12e-3
"""Radius in m of the circle on which each ball moves."""

CENTRE_M = 28e-3
"""Distance in m of the centre of each circle from the middle of the skin, along both x and y."""

BALL_RADIUS_M = 15e-3
"""Radius in m of each ball; its contact is about 9 mm wide."""

FORCE_N = 3.0
"""Largest normal force of each ball, in N."""

FRICTION = 0.3
"""Friction coefficient of the balls, which slide."""


def write_balls(folder: Path) -> Path:
    """Write the load script into a folder, and return its path."""
    angle = np.linspace(0, 2 * np.pi, 17)
    circle = CIRCLE_RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    indenters = []
    for number, (x, y) in enumerate([(-1, -1), (1, -1), (-1, 1), (1, 1)]):
        path = np.add(circle, [CENTRE_M * x, CENTRE_M * y, DEPTH])
        begin_s = number * DELAY_S
        slide = {
            "from": begin_s,
            "to": begin_s + MOVING_S,
            "path": path.tolist(),
            "force": [0.0, *[FORCE_N] * 15, 0.0],
        }
        ball = {"name": f"ball{number}", "shape": "sphere", "radius": BALL_RADIUS_M}
        indenters.append(ball | {"friction": FRICTION, "does": [{"slide": slide}]})
    script = folder / "balls.yaml"
    write_yaml(script, {"period": PERIOD_S, "depth": DEPTH, "indenters": indenters})
    return script
