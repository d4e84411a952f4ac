"""Controls of the page: what is drawn, what colours mean, where a replay is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import viser

from ..core.modes import COMPONENTS
from ..views.scene import QUANTITIES, Quantity
from . import markup
from .history import History
from .moment import DEVIATION, SurfaceField

SLIDER_STEP_S = 0.1
"""Step of the slider of a replay, in seconds."""

PART_LABELS = {
    "field": "field between the cubes",
    "traction": "traction arrows",
    "gradient": "gradient arrows",
    "principal": "principal stresses",
    "names": "names of cubes",
}
"""Part of the 3-D view, as in `Shown` -> text of its check box."""


@dataclass
class Shown:
    """Which parts of the 3-D view are drawn."""

    field: bool = True
    traction: bool = True
    gradient: bool = True
    principal: bool = False
    names: bool = False


class ReplayPosition(Protocol):
    """Where a replay is, as in ReplayState.msg: position and length in seconds."""

    position: float
    length: float
    paused: bool


class ColourControls:
    """The quantity that is shown in colours, the top of its range, and the legend."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[], None]) -> None:
        """changed: called when another quantity is chosen."""
        labels = [quantity.label for quantity in QUANTITIES.values()]
        self._quantity = gui.add_dropdown("colour", labels)
        self._quantity.on_update(lambda _: changed())
        self._range = gui.add_number("top (0: auto)", 0.0, min=0.0, step=0.1)
        self._legend = gui.add_html("")

    @property
    def quantity(self) -> Quantity:
        """The chosen quantity; the first one if the browser has sent an unknown text."""
        offered = (*QUANTITIES.values(), DEVIATION)
        chosen = [one for one in offered if one.label == self._quantity.value]
        return chosen[0] if chosen else next(iter(QUANTITIES.values()))

    @property
    def fixed_top(self) -> float:
        """The top of the range that the user wants, in SI units; 0: it follows the values."""
        value = float(self._range.value)
        return value * self.quantity.size if math.isfinite(value) and value > 0 else 0.0

    def offer_known(self, history: History, field: SurfaceField) -> None:
        """Offer the quantities that some cube observes, and the standard deviation if known.

        A chosen standard deviation stays, so that colours do not change their meaning when the
        node `contacts` ends.
        """
        observed = dict(zip(History.COLUMNS, history.observed, strict=True))
        if not any(observed[name] for name in COMPONENTS):
            return
        labels = [
            quantity.label
            for name, quantity in QUANTITIES.items()
            if name not in COMPONENTS or observed[name]
        ]
        if field.sigma is not None or self.quantity is DEVIATION:
            labels.append(DEVIATION.label)
        # Setting the options sends them, and closes a list that the user has just opened.
        if tuple(labels) != tuple(self._quantity.options):
            self._quantity.options = labels

    def write_legend(self, top: float, field: SurfaceField) -> None:
        """Write the legend; top: of the range in use, in SI units."""
        if self.quantity is DEVIATION and field.sigma is None:
            self._legend.content = markup.no_deviation()
        else:
            self._legend.content = markup.legend(self.quantity, top)


def add_part_controls(gui: viser.GuiApi, shown: Shown) -> None:
    """Add a check box for each part of the 3-D view, which sets the field of `shown`."""
    for field in fields(Shown):
        _add_check_box(gui, shown, field.name)


def _add_check_box(gui: viser.GuiApi, shown: Shown, name: str) -> None:
    box = gui.add_checkbox(PART_LABELS[name], getattr(shown, name))
    box.on_update(lambda _: setattr(shown, name, bool(box.value)))


class ReplayControls:
    """A slider that shows and sets where a replay is, and a button to stop it; hidden without one.

    Attributes:
        is_held: Whether there is a replay and it is stopped.
    """

    def __init__(
        self, gui: viser.GuiApi, hold: Callable[[], None], jump: Callable[[float], None]
    ) -> None:
        """Add the controls.

        Args:
            gui: The panel.
            hold: Called to stop the replay or let it go on.
            jump: Called with a position in seconds.
        """
        self.is_held = False
        with gui.add_folder("replay", visible=False) as self._folder:
            self._position = gui.add_html("")
            self._slider = gui.add_slider("time / s", 0.0, 1.0, SLIDER_STEP_S, 0.0)
            self._button = gui.add_button("stop the replay")
        self._drawn = 0.0
        self._button.on_click(lambda _: hold())

        @self._slider.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            # Updates by `show` come from here and have no client.
            if event.client is None:
                return
            position = self._slider.value
            # A browser may send any number.
            if not math.isfinite(position):
                self._slider.value = self._drawn  # type: ignore[misc]
                return
            jump(position)
            self._drawn = position

    def show(self, replay: ReplayPosition | None) -> None:
        """Show where a replay is; None: there is none."""
        self.is_held = replay is not None and replay.paused
        self._folder.visible = replay is not None
        if replay is None:
            return
        steps = math.ceil(replay.length / SLIDER_STEP_S)
        self._slider.max = max(round(steps * SLIDER_STEP_S, 1), SLIDER_STEP_S)
        self._move_slider(round(min(replay.position, self._slider.max), 1))
        position, length = markup.clock(replay.position), markup.clock(replay.length)
        self._position.content = markup.box(f"<b>{position}</b> of {length}")
        self._button.label = "go on with the replay" if replay.paused else "stop the replay"

    def _move_slider(self, position: float) -> None:
        # What the user has set stays until its event has been handled: it comes in another thread
        # and may be late.
        if self._slider.value == self._drawn and position != self._drawn:
            self._drawn = position
            self._slider.value = position  # type: ignore[misc]
