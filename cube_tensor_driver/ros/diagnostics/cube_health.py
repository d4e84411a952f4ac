"""Health of the cubes in words: diagnostics of the cubes that are not fine, a line in the log when
that changes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...config.skin import Skin
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows
from ...core.status import LEFT_OUT, WORDS
from .updater import make_status

MAX_STATUSES = 64
"""In one message: on a skin whose hubs are all gone, a status for each of 1000 cubes helps
nobody."""


MISSING = "missing: no row yet, see its link"
TIMES_TO_START = 5
"""Times that `statuses` is called, before a cube that has sent nothing yet gets a line: hubs may
start after us."""


class CubeHealth:
    """Turns what `Health` found since the last time into words."""

    def __init__(self, skin: Skin, reconstructor: Reconstructor) -> None:
        self._skin, self._pipeline = skin, reconstructor.pipeline
        self._health = reconstructor.health
        self._came = np.zeros(len(skin.cubes), bool)
        self._words: dict[int, str] = {}
        self._said: dict[int, str] = {}
        self._times = 0

    def statuses(
        self, uids: Mapping[int, int]
    ) -> tuple[list[DiagnosticStatus], list[tuple[str, bool]]]:
        """Statuses of cubes that are not fine or were not the last time; of what changed a line,
        and if it is bad."""
        bits, strained, rows = self._health.collect()
        self._times += 1
        self._came |= rows > 0
        levels = np.zeros(len(rows), int)
        levels[strained | (bits != 0).any(axis=1)] = 1
        levels[(bits & LEFT_OUT != 0).any(axis=1)] = 2
        levels[rows == 0] = 3
        suspects = self._suspects(strained)
        words = {
            int(cube): self._describe(
                int(cube), bits[cube], bool(strained[cube]), bool(rows[cube]), suspects
            )
            for cube in np.flatnonzero(levels)[:MAX_STATUSES]
        }
        statuses, lines = [], []
        for cube in sorted({*words, *self._words}):
            text = words.get(cube, "fine")
            level = int(levels[cube]) if cube in words else 0
            name = self._skin.cubes[cube].name
            starting = self._times <= TIMES_TO_START and text == MISSING
            if text != self._said.get(cube, "fine") and not starting:
                self._said[cube] = text
                lines.append((f"cube {name}: {text}", level > 0))
            uid = self._skin.cubes[cube].uid or uids.get(cube, 0)
            values = {"rows since the last": int(rows[cube])}
            statuses.append(
                make_status(
                    f"cube {name}", f"{uid:#x}" if uid else "", bytes([level]), text, values
                )
            )
        self._words = words
        return statuses, lines

    def summary(self) -> dict[str, int]:
        """How many pads and cubes are how, now; only what there is."""
        counts = {
            f"pads {word}": int(np.count_nonzero(self._health.state & bit))
            for bit, word in WORDS.items()
        }
        counts["cubes with a residual"] = int(np.count_nonzero(self._health.high_residual))
        return {name: count for name, count in counts.items() if count}

    def _describe(
        self,
        cube: int,
        bits: np.ndarray,
        strained: bool,
        came: bool,
        suspects: dict[int, list[str]],
    ) -> str:
        if not came:
            return "stale: no rows any more, see its link" if self._came[cube] else MISSING
        pads = self._skin.cubes[cube].calibration.layout.pads
        texts = [
            f"pad {pads[pad]} {_words(int(bits[pad]))}" for pad in np.flatnonzero(bits).tolist()
        ]
        if strained:
            named = suspects.get(cube)
            texts.append(
                "residual above its level: "
                + (
                    f"pad {' or '.join(named)} may be bad"
                    if named
                    else "a pad is bad, or the load is outside the modes of this layout"
                )
            )
        return "; ".join(texts)

    def _suspects(self, strained: np.ndarray) -> dict[int, list[str]]:
        """Pads of which one alone would explain the newest residual, by cube."""
        cubes = np.flatnonzero(strained)
        if not len(cubes):
            return {}
        health = self._health
        newest = FrequencyRows.of(cubes, health.last[cubes], temperature=health.temperature[cubes])
        found = self._pipeline.suspects(newest, health.mask[cubes])
        return {
            cube: [
                self._skin.cubes[cube].calibration.layout.pads[pad] for pad in np.flatnonzero(row)
            ]
            for cube, row in zip(cubes.tolist(), found, strict=True)
        }


def _words(bits: int) -> str:
    """The conditions of a pad in words."""
    return " and ".join(word for bit, word in WORDS.items() if bits & bit)
