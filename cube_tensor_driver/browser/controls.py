"""Controls of the page: what is drawn, what colours mean, where a replay is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Protocol

import viser

from ..core.modes import COMPONENTS
from ..views.scene import QUANTITIES, Quantity
from . import markup
from .history import History
from .moment import DEVIATION, SurfaceField
from .scene_3d import Shown

STEP_S = 0.1
"""Of the slider of a replay."""
SHOWN_LABELS = {
    "field": "field between the cubes",
    "traction": "traction arrows",
    "gradient": "gradient arrows",
    "principal": "principal stresses",
    "names": "names of cubes",
}


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
        self._range = gui.add_number("top (0: auto)", 0.0, min=0.0, step=0.1)
        self._legend = gui.add_html("")

    @property
    def quantity(self) -> Quantity:
        offered = (*QUANTITIES.values(), DEVIATION)
        chosen = [one for one in offered if one.label == self._quantity.value]
        # A browser may send any text.
        return chosen[0] if chosen else next(iter(QUANTITIES.values()))

    @property
    def top(self) -> float:
        """The top of the range that the user wants, SI; 0: it follows what is there."""
        value = float(self._range.value)
        return value * self.quantity.size if math.isfinite(value) and value > 0 else 0.0

    def offer_known(self, history: History, field: SurfaceField) -> None:
        """Offer only what some cube observes, and the standard deviation if the field has one.

        Once chosen it stays: the colours do not change their meaning because a node ends.
        """
        observed = dict(zip(History.COLUMNS, history.observed, strict=True))
        if not any(observed[name] for name in COMPONENTS):
            return
        seen = [
            quantity.label
            for name, quantity in QUANTITIES.items()
            if name not in COMPONENTS or observed[name]
        ]
        if field.sigma is not None or self.quantity is DEVIATION:
            seen.append(DEVIATION.label)
        if tuple(seen) != tuple(self._quantity.options):
            self._quantity.options = seen

    def write_legend(self, top: float, field: SurfaceField) -> None:
        """top: of the range in use, SI."""
        if self.quantity is DEVIATION and field.sigma is None:
            self._legend.content = markup.no_deviation()
        else:
            self._legend.content = markup.legend(self.quantity, top)


class ShownControls:
    """Check boxes for the parts of the 3-D view."""

    def __init__(self, gui: viser.GuiApi, shown: Shown) -> None:
        for field in fields(Shown):
            self._add(gui, shown, field.name)

    def _add(self, gui: viser.GuiApi, shown: Shown, name: str) -> None:
        box = gui.add_checkbox(SHOWN_LABELS[name], getattr(shown, name))
        box.on_update(lambda _: setattr(shown, name, bool(box.value)))


class ReplayControls:
    """A slider that shows and sets where a replay is, and a button to stop it; hidden without one.

    held: whether the replay is stopped.
    """

    def __init__(
        self, gui: viser.GuiApi, hold: Callable[[], None], jump: Callable[[float], None]
    ) -> None:
        """hold: called to stop or go on; jump: called with a position in s."""
        self.held = False
        with gui.add_folder("replay", visible=False) as self._folder:
            self._position = gui.add_html("")
            self._slider = gui.add_slider("time / s", 0.0, 1.0, STEP_S, 0.0)
            self._button = gui.add_button("stop the replay")
        self._drawn = 0.0
        self._button.on_click(lambda _: hold())

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            # Updates that `show` makes have no client.
            if event.client is None:
                return
            position = self._slider.value
            # A browser may send any number.
            if not math.isfinite(position):
                self._slider.value = self._drawn  # type: ignore[misc]
                return
            jump(position)
            self._drawn = position

    def show(self, replay: ReplayState | None) -> None:
        """Show where a replay is; None: there is none."""
        self.held = replay is not None and replay.paused
        self._folder.visible = replay is not None
        if replay is None:
            return
        self._slider.max = max(round(math.ceil(replay.length / STEP_S) * STEP_S, 1), STEP_S)
        self._draw(round(min(replay.position, self._slider.max), 1))
        self._position.content = markup.box(
            f"<b>{markup.clock(replay.position)}</b> of {markup.clock(replay.length)}"
        )
        self._button.label = "go on with the replay" if replay.paused else "stop the replay"

    def _draw(self, position: float) -> None:
        # What the user has set stays until its event has been seen, which comes in another thread
        # and may be late.
        if self._slider.value == self._drawn and position != self._drawn:
            self._drawn = position
            self._slider.value = position  # type: ignore[misc]
