"""What the reconstruction says in /diagnostics: rows, messages, tare, and the health of cubes."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...config.skin import Skin
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...core.status import INVALID
from .cube_health import CubeHealth
from .lost_messages import LostMessages
from .updater import make_status

LOST_WHERE = "by the network, or this node was too late for its queue"


class TareState(Protocol):
    """What diagnostics ask of tare: uids by cube, and its age in words."""

    uids: dict[int, int]

    def age(self) -> dict[str, str]: ...


class ReconstructionDiagnostics:
    """Counts what the node does. bad_messages: refused."""

    def __init__(
        self, skin: Skin, reconstructor: Reconstructor, tare: TareState, lost: LostMessages
    ) -> None:
        self.bad_messages = 0
        self._skin, self._tare, self._lost = skin, tare, lost
        self._cubes = CubeHealth(skin, reconstructor)
        self._rows = self._invalid = 0
        self._rows_before = self._lost_before = 0  # at the last diagnostics

    def count(self, rows: StressRows) -> None:
        """Rows that were published."""
        self._rows += len(rows)
        self._invalid += int(np.count_nonzero(rows.status & INVALID))

    def statuses(self) -> tuple[list[DiagnosticStatus], list[tuple[str, bool]]]:
        """A status of all rows and one for each cube with a fault, or that had one; lines for the
        log, and whether each is bad news."""
        cubes, lines = self._cubes.statuses(self._tare.uids)
        values = {
            "rows": self._rows,
            "rows per second": self._rows - self._rows_before,
            "invalid rows": self._invalid,
            "messages lost on the way": self._lost.count,
            "messages that contradict themselves": self.bad_messages,
            **self._tare.age(),
            **self._cubes.summary(),
        }
        lost = self._lost.count - self._lost_before
        self._rows_before, self._lost_before = self._rows, self._lost.count
        text = f"{lost} messages lost on the way: {LOST_WHERE}" if lost > 0 else ""
        level = DiagnosticStatus.WARN if self.bad_messages or text else DiagnosticStatus.OK
        return [make_status("rows", self._skin.name, level, text, values), *cubes], lines


def log_changes(logger: Any, changes: list[tuple[str, bool]]) -> None:
    """A line for each; bad news are warnings."""
    for line, bad in changes:
        # rclpy ties a level to a line of code.
        if bad:
            logger.warning(line)
        else:
            logger.info(line)
