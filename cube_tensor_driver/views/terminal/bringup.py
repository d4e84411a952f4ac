"""What ./cube bringup shows: the pads while they rest, what to press, and what the presses say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table

from ...calibrate.pad_order import Explanation
from ...calibrate.pad_rest import PadsAtRest
from ...core.tensor import quaternion_from_rotation, rpy_from_quaternion

PPM = 1e6
OK = "ok"


class BringupScreen:
    """Prints to stdout; in a terminal the table of pads is live."""

    def __init__(self, cubes: Sequence[str], pads: Sequence[str]) -> None:
        """cubes, pads: names."""
        self._cubes, self._pads = cubes, pads
        self._console = Console(highlight=False)
        self._live = Live(console=self._console, transient=True, auto_refresh=False)

    def __enter__(self) -> BringupScreen:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show_rest(self, rest: PadsAtRest) -> None:
        """The live table of pads."""
        if self._live.is_started:
            self._live.update(self._table(rest), refresh=True)

    def end_rest(self, rest: PadsAtRest) -> None:
        """The table as it was at the end."""
        self._live.stop()
        self._console.print(self._table(rest))

    def say(self, text: str, style: str = "") -> None:
        self._console.print(text, style=style, markup=False, soft_wrap=True)

    def verdict(self, name: str, found: Explanation) -> None:
        """What the presses of a cube say."""
        if not found.is_clear:
            fit = f"{100 * found.misfit:.0f} % of what its pads measured is not explained"
            why = "several explanations fit" if found.misfit < 0.5 else fit
            self.say(f"{name}: the presses do not say how it sits ({why})", "red")
            return
        words = []
        if found.is_turned:
            words.append(f"turned, rpy {turn_text(found.turn)}")
        if found.swapped:
            names = ", ".join(
                f"{self._pads[wire]} is {self._pads[found.places[wire]]}" for wire in found.swapped
            )
            words.append(f"pads are swapped: {names}")
        style = "red" if found.swapped else "yellow" if words else "green"
        self.say(f"{name}: {'; '.join(words) or 'as it should be'}", style)

    def _table(self, rest: PadsAtRest) -> Table:
        table = Table("cube", "pad")
        for name in ("f / Hz", "noise / ppm", "drift / (ppm/min)"):
            table.add_column(name, justify="right")
        table.add_column("state")
        for cube, pad in np.ndindex(rest.frequency.shape):
            state = pad_state(rest, cube, pad)
            numbers = ("", "", "")
            if np.isfinite(rest.frequency[cube, pad]):
                numbers = (
                    f"{rest.frequency[cube, pad]:.1f}",
                    f"{PPM * rest.noise[cube, pad]:.1f}",
                    f"{PPM * rest.drift[cube, pad]:+.0f}",
                )
            style = "" if state == OK else "red"
            table.add_row(
                self._cubes[cube] if pad == 0 else "", self._pads[pad], *numbers, state, style=style
            )
        return table


def pad_state(rest: PadsAtRest, cube: int, pad: int) -> str:
    """silent, stuck, noisy or ok."""
    for name in ("silent", "stuck", "noisy"):
        if getattr(rest, name)[cube, pad]:
            return name
    return OK


def turn_text(turn: np.ndarray) -> str:
    """Roll, pitch and yaw in degrees."""
    angles = np.degrees(rpy_from_quaternion(quaternion_from_rotation(turn)))
    return " ".join(f"{angle:.0f}°" for angle in angles + 0.0)
