"""Controls of the page that belong together: what colours mean, where a replay is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import viser

from ..core.scene import QUANTITIES, Quantity
from . import markup

STEP_S = 0.1
"""Of the slider of a replay."""


class ReplayState(Protocol):
    """How far a replay is, as in ReplayState.msg."""

    position: float
    length: float
    paused: bool


class ColourControls:
    """What colours mean: the quantity, the top of its range, and the legend."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[], None]) -> None:
        """changed: called when another quantity is chosen."""
        labels = [quantity.label for quantity in QUANTITIES.values()]
        self._quantity = gui.add_dropdown("colour", labels)
        self._quantity.on_update(lambda _: changed())
        self._range = gui.add_number("range (0: auto)", 0.0, min=0.0, step=0.1)
        self._legend = gui.add_html("")

    @property
    def quantity(self) -> Quantity:
        chosen = [one for one in QUANTITIES.values() if one.label == self._quantity.value]
        # A browser may send any text.
        return chosen[0] if chosen else next(iter(QUANTITIES.values()))

    @property
    def top(self) -> float:
        """The top of the range that the user wants, SI; 0: it follows what is there."""
        value = float(self._range.value)
        return value * self.quantity.size if math.isfinite(value) and value > 0 else 0.0

    def write_legend(self, top: float) -> None:
        """top: of the range in use, SI."""
        self._legend.content = markup.legend(self.quantity, top)


class ReplayControls:
    """A slider that shows and sets where a replay is, and a button to hold it; hidden without one.

    held: whether the replay is paused.
    """

    def __init__(
        self, gui: viser.GuiApi, hold: Callable[[], None], jump: Callable[[float], None]
    ) -> None:
        """hold: called to hold or go on; jump: called with a position in s."""
        self.held = False
        with gui.add_folder("replay", visible=False) as self._folder:
            self._slider = gui.add_slider("s", 0.0, 1.0, STEP_S, 0.0)
            self._button = gui.add_button("hold")
        self._button.on_click(lambda _: hold())

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            # Updates that `show` makes have no client.
            if event.client is not None and math.isfinite(self._slider.value):
                jump(self._slider.value)

    def show(self, replay: ReplayState | None) -> None:
        """Show where a replay is; None: there is none."""
        self.held = replay is not None and replay.paused
        self._folder.visible = replay is not None
        if replay is not None:
            self._slider.max = max(replay.length, STEP_S)
            self._slider.value = min(replay.position, self._slider.max)  # type: ignore[misc]
            self._button.label = "play" if replay.paused else "hold"
