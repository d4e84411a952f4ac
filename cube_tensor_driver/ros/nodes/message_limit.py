"""How many rows of one cube a message of frequencies may have."""

from __future__ import annotations

import numpy as np

from ...core.errors import MessageError
from ...core.rows import FrequencyRows
from ..node import CubeNode, scans_per_message

MAX_SCANS = 1000
"""Rows of one cube in one message, if publish_period does not need more. Each may take 0.3 ms of a
skin of 1280 cubes, and the node does nothing else meanwhile."""


def scan_limit(node: CubeNode, rate: float | None) -> int:
    """The limit for a node with parameter publish_period; rate: samples per second, None: not
    known."""
    # One more than asked for, as drivers may gather it; twice, because rates are not exact.
    scans = scans_per_message(node.value("publish_period"), rate)
    return max(MAX_SCANS, 2 * (scans + 1))


def check_scans(rows: FrequencyRows, limit: int) -> None:
    """MessageError: more rows of one cube in a message than the limit."""
    if len(rows) <= limit:
        return
    counts = np.bincount(rows.cube)
    if counts.max() > limit:
        raise MessageError(
            f"a message has {counts.max()} rows of cube {counts.argmax()}, the limit is {limit}: "
            "set parameter publish_period to the driver's"
        )
