# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Controls of the page: parts of the 3-D view, quantity of the colours, position of a replay."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import viser

from ..views.scene import QUANTITIES, Quantity
from . import markup
from .surface_field import DEVIATION

SLIDER_STEP_S = 0.1
"""Step, in seconds, between two positions of the slider that sets the time within a replay."""

PARTS = {
    "field": "field on the surface",
    "traction": "traction arrows",
    "gradient": "gradient arrows",
    "principal": "principal stresses",
    "names": "names of cubes",
}
"""Name of a part of the 3-D view -> text of the check box that shows or hides this part."""

FIRST_PARTS = {"field", "traction", "gradient"}
"""Names of the parts of the 3-D view that are shown when the page opens."""


class ReplayPosition(Protocol):
    """The fields of ReplayState.msg that the page uses.

    Attributes:
        position: Time of the replay, in s after the start of the bag.
        length: Duration of the bag, in s.
        paused: Whether the replay is stopped.
    """

    position: float
    length: float
    paused: bool


class ColourControls:
    """The list of quantities for the colours, the upper end of the colour scale, and the legend.

    Attributes:
        list: Drop-down list of the quantities.
        legend: HTML element with the legend.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        labels = [quantity.label for quantity in QUANTITIES.values()]
        self.list = gui.add_dropdown("colour", labels)
        self._range = gui.add_number(
            "top (0: auto)",
            0.0,
            min=0.0,
            step=0.1,
        )
        self.legend = gui.add_html("")

    @property
    def quantity(self) -> Quantity:
        """The quantity that the user chose; the first one if the browser sent an unknown text."""
        offered = (*QUANTITIES.values(), DEVIATION)
        chosen = [one for one in offered if one.label == self.list.value]
        return chosen[0] if chosen else next(iter(QUANTITIES.values()))

    @property
    def fixed_top(self) -> float:
        """Upper end of the colour scale that the user entered, in SI units; 0: it is automatic."""
        value = float(self._range.value)
        return value * self.quantity.size if math.isfinite(value) and value > 0 else 0.0


class ReplayControls:
    """A slider for the time within a replay, and a button to stop it; hidden without a replay."""

    def __init__(
        self,
        gui: viser.GuiApi,
        hold: Callable[[], None],
        jump: Callable[[Callable[[], float]], None],
    ) -> None:
        """Add the controls.

        Args:
            gui: The controls of one browser.
            hold: Function that stops the replay, or lets it continue if it is stopped.
            jump: Function that is called, in a thread of viser, when the user has set a position.
                Its argument is a function that returns the position, in s after the start of the
                bag; it must be called in the thread that calls `show`.
        """
        self.is_held = False
        with gui.add_folder("replay", visible=False) as self._folder:
            self._position = gui.add_html("")
            self._slider = gui.add_slider(
                "time / s",
                0.0,
                1.0,
                SLIDER_STEP_S,
                0.0,
            )
            self._button = gui.add_button("stop the replay")
        self._drawn = 0.0
        self._button.on_click(lambda _: hold())

        @self._slider.on_update
        def _(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            # `_move_slider` triggers this function, too; such an event has no client (browser).
            if event.client is None:
                return
            jump(self._take_position)

    def _take_position(self) -> float:
        # A browser may send any number, also NaN or infinity.
        if not math.isfinite(self._slider.value):
            self._slider.value = self._drawn  # type: ignore[misc]
        self._drawn = float(self._slider.value)
        return self._drawn

    def show(self, replay: ReplayPosition | None) -> None:
        """Show position, length and state of a replay.

        Args:
            replay: State of the replay; None: there is no replay, and the controls are hidden.
        """
        self.is_held = replay is not None and replay.paused
        self._folder.visible = replay is not None
        if replay is None:
            return
        steps = math.ceil(replay.length / SLIDER_STEP_S)
        self._slider.max = max(round(steps * SLIDER_STEP_S, 1), SLIDER_STEP_S)
        self._move_slider(round(min(replay.position, self._slider.max), 1))
        position, length = markup.format_clock(replay.position), markup.format_clock(replay.length)
        self._position.content = markup.put_in_box(f"<b>{position}</b> of {length}")
        self._button.label = "go on with the replay" if replay.paused else "stop the replay"

    def _move_slider(self, position: float) -> None:
        # If the slider does not have the value `_drawn` that this object gave it last, the user has
        # moved it, and `_take_position` has not read the new value yet. Until then the slider must
        # not be moved, because the position that the user has chosen would be lost.
        if self._slider.value == self._drawn and position != self._drawn:
            self._drawn = position
            self._slider.value = position  # type: ignore[misc]
