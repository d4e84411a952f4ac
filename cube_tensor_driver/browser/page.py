"""The page of the browser view: the skin in 3-D, controls, plots, and the skin from above.

It uses viser but not ROS. Each browser has a page of its own, with its own settings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from ..core.arrays import Array
from ..core.poses import CubePoses
from ..touch.surface import Surface
from . import markup
from .charts import Charts
from .colouring import Colouring
from .controls import ColourControls, ReplayControls, ReplayPosition, add_part_controls
from .history import History
from .markup import PageStatus
from .moment import Moment
from .scene_3d import SPAN, Scene3D
from .top_view import TopView

MAX_SURFACE_POINTS = 5000
"""Approximate number of points of the surface at which the field is drawn."""

MAX_POINTS_PER_SIDE = 12
"""Number of points of the surface along one side of a cube's part of it."""

BRAND_COLOUR = (24, 100, 171)
BACKGROUND = (246, 247, 249)

LEFT_WIDTH = 440.0
"""Width of the panel with the plots, in pixels."""

RIGHT_WIDTH = 320.0
"""Width of viser's main panel, in pixels."""

CAMERA_POSITION = np.array([0.1, -1.0, 1.05]) * SPAN
"""Position of the camera, in units of the scene, for a picture of normal proportions."""

CAMERA_TARGET = np.array([0.0, -0.04, 0.0]) * SPAN
"""Point that the camera looks at, in units of the scene."""

PHONE_TARGET = np.array([0.0, -0.45, -0.3]) * SPAN
"""Point that the camera looks at on a phone, whose panels cover the lower part of the picture."""

MIN_CAMERA_DISTANCE = 0.95
"""Smallest distance of the camera, relative to that of `CAMERA_POSITION`."""

DISTANCE_PER_ASPECT = 0.78
"""Distance of the camera, relative to that of `CAMERA_POSITION`, times the free width over the
height of the picture. In narrow pictures the camera must be further away."""

PAUSE = "pause the page"
GO_ON = "go on"
RECORD = "record"
STOP = "stop recording"
TARE = "tare"
CLEAR_TARE = "undo tare"

NOTE_S = 8.0
"""Time, in seconds, for which a note is shown."""


@dataclass(frozen=True)
class Buttons:
    """What the buttons of the page do. They are called in threads of viser and return at once.

    Attributes:
        tare: Take the present load as zero load.
        clear_tare: Undo that.
        record: Begin or end a recording.
        hold: Stop a replay or let it go on.
        jump: Jump to a position of a replay, in seconds.
    """

    tare: Callable[[], None]
    clear_tare: Callable[[], None]
    record: Callable[[], None]
    hold: Callable[[], None]
    jump: Callable[[float], None]


class ShownSkin:
    """A skin as all pages show it.

    Attributes:
        name: Name of the skin.
        names: Names of its cubes.
        poses: Poses of its cubes.
        surface: Points of the field, between the cubes.
        top_view: The drawing from above.
        history: The values of the last seconds.
    """

    def __init__(
        self, name: str, names: Sequence[str], poses: CubePoses, depth: float, history: History
    ) -> None:
        """depth: of the centres of the cubes below the surface, in metres."""
        # A large skin gets fewer points per cube, so that the whole stays within the limit.
        points_per_side = np.sqrt(MAX_SURFACE_POINTS / len(names))
        points_per_side = np.clip(points_per_side, 2, MAX_POINTS_PER_SIDE)
        self.name, self.names, self.poses = name, list(names), poses
        self.surface = Surface(poses, depth, int(points_per_side))
        self.top_view = TopView(names, poses, self.surface)
        self.history = history


class Page:
    """The page of one skin in one browser."""

    def __init__(
        self,
        client: viser.ClientHandle,
        skin: ShownSkin,
        buttons: Buttons,
    ) -> None:
        self._client = client
        self._skin = skin
        self._moment: Moment | None = None
        self._paused = False
        self._is_complete = False
        self._written = 0
        self._top = 0.0
        self._noted = ""
        set_up(client, skin.name)
        self._scene = Scene3D(client.scene, skin.names, skin.poses, skin.surface, self._choose)
        self._make_controls(client.gui, buttons)
        self._make_panel(client.gui)

    @property
    def paused(self) -> bool:
        """Whether the user has paused the page."""
        return self._paused

    def close(self) -> None:
        """Remove everything from the browser."""
        self._client.scene.remove_click_callback()
        self._client.scene.reset()
        self._client.gui.reset()

    def show_replay(self, replay: ReplayPosition | None) -> None:
        """Show where a replay is; None: there is none."""
        self._replay.show(replay)

    def show(
        self,
        moment: Moment,
        rate: Array,
        status: PageStatus,
        with_numbers: bool,
    ) -> None:
        """Show a moment; while the page is paused it keeps the moment it has.

        Args:
            moment: What is shown.
            rate: (N,) rows per second of each cube.
            status: Links, recording, and the last action of the user.
            with_numbers: Whether to show what changes less often, too: numbers and plots.
        """
        # The browser shows all of it in one picture, or the field would be ahead of the cubes.
        with self._client.atomic():
            if not self._paused or self._moment is None:
                self._moment = moment
                self._draw(moment)
            self._write_first_lines(self._moment, rate, status)
            if self._paused and not self._is_complete:
                # Then all that is shown while the page is paused is of one moment.
                self._write_plots()
                self._write_numbers(self._moment, rate, status)
                self._is_complete = True
            elif with_numbers and not self._paused:
                self._write(self._moment, rate, status)

    def _draw(self, moment: Moment) -> None:
        controls = self._colours
        self._colouring = Colouring.of(
            moment, self._skin.surface, controls.quantity, controls.fixed_top, self._top
        )
        self._top = self._colouring.top
        self._scene.draw(moment, self._colouring)

    def _write_first_lines(
        self,
        moment: Moment,
        rate: Array,
        status: PageStatus,
    ) -> None:
        is_held = self._paused or self._replay.is_held
        hertz = float(np.fmax.reduce(rate, axis=None, initial=0.0))
        line = markup.headline(
            moment.health, hertz, moment.strongest_contact, is_held, status.recording
        )
        # Each assignment is sent, even if nothing has changed.
        if line != self._headline.content:
            self._headline.content = line
        # The button groups show what a press will do.
        view = (GO_ON if self._paused else PAUSE, STOP if status.recording else RECORD)
        if tuple(self._view.options) != view:
            self._view.options = view
        if status.action != self._noted:
            self._noted = status.action
            self._action.content = markup.action_line(status.action)
            self._client.add_notification(
                status.title, status.action, auto_close_seconds=NOTE_S, color=status.colour
            )

    def _write(
        self,
        moment: Moment,
        rate: Array,
        status: PageStatus,
    ) -> None:
        """Write plots and numbers in alternate calls, because each costs a browser as much time
        as a picture."""
        self._written += 1
        if self._written % 2:
            self._write_plots()
        else:
            self._write_numbers(moment, rate, status)

    def _write_plots(self) -> None:
        self._charts.draw(self._skin.history, self._scene.selected)

    def _write_numbers(
        self,
        moment: Moment,
        rate: Array,
        status: PageStatus,
    ) -> None:
        history, cube = self._skin.history, self._scene.selected
        self._charts.offer_observed(history)
        self._colours.offer_known(history, moment.field)
        self._colours.write_legend(self._top, moment.field)
        scene = self._scene
        self._meaning.content = markup.explanation(
            scene.bar, scene.bar_stress(), scene.bar_gradient(), moment.field.sigma
        )
        self._numbers.content = markup.numbers(moment, cube, rate[cube])
        self._health.content = markup.conditions(self._skin.names, moment.health, status.links)
        self._above.content = self._skin.top_view.draw(self._colouring, moment.contacts, cube)

    def _make_controls(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        """Make the main panel, from top to bottom."""
        # A style sheet can be anywhere on the page.
        gui.add_html(markup.PHONE_STYLE)
        self._headline = gui.add_html("")
        self._make_buttons(gui, buttons)
        self._action = gui.add_html("")
        self._replay = ReplayControls(gui, buttons.hold, buttons.jump)
        self._colours = ColourControls(gui, self._quantity_changed)
        names = self._skin.names
        selected = names[self._scene.selected]
        self._cube = gui.add_dropdown("cube", names, initial_value=selected)

        @self._cube.on_update
        def _(_: object) -> None:
            # A browser may send any text.
            if self._cube.value in names:
                self._scene.selected = names.index(self._cube.value)

        with gui.add_folder("numbers of the chosen cube"):
            self._numbers = gui.add_html("")
        with gui.add_folder("what is drawn"):
            self._meaning = gui.add_html("")
            add_part_controls(gui, self._scene.shown)
        with gui.add_folder("health"):
            self._health = gui.add_html("")

    def _make_panel(self, gui: viser.GuiApi) -> None:
        """Make the second panel: plots, and the skin from above."""
        panel = gui.add_panel()
        self._charts = Charts(
            gui, panel.add_tab("plots of 10 s", viser.Icon.CHART_LINE), self._skin.names
        )
        with panel.add_tab("from above", viser.Icon.MAP):
            self._above = gui.add_html("")
        panel.dock_left()
        panel.set_width(LEFT_WIDTH)

    def _make_buttons(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        self._view = gui.add_button_group("view", (PAUSE, RECORD))
        zero = gui.add_button_group(
            "zero", (TARE, CLEAR_TARE), hint="tare takes the present load as zero load"
        )
        actions: dict[str, Callable[[], None]] = {
            PAUSE: self._toggle_pause,
            GO_ON: self._toggle_pause,
            RECORD: buttons.record,
            STOP: buttons.record,
            TARE: buttons.tare,
            CLEAR_TARE: buttons.clear_tare,
        }

        @self._view.on_click
        @zero.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            # A browser may send any text.
            action = actions.get(str(event.target.value))
            if action is not None:
                action()

    def _toggle_pause(self) -> None:
        self._paused, self._is_complete = not self._paused, False

    def _quantity_changed(self) -> None:
        """Begin the automatic range anew: that of another quantity says nothing."""
        self._top = 0.0

    def _choose(self, cube: int) -> None:
        # viser's handle has a setter, which its type does not show.
        self._cube.value = self._skin.names[cube]  # type: ignore[misc]


class WaitingPage:
    """What a browser shows before there is a skin."""

    def __init__(self, client: viser.ClientHandle, text: str) -> None:
        set_up(client, "no skin yet")
        self._text = client.gui.add_html(markup.PHONE_STYLE + markup.box(text))
        self._label = client.scene.add_label(
            "/waiting", "Waiting for a skin …", anchor="center-center", font_screen_scale=1.6
        )

    def close(self) -> None:
        """Remove everything from the browser."""
        self._text.remove()
        self._label.remove()


def set_up(client: viser.ClientHandle, name: str) -> None:
    """Set colours, panel and camera of a page; name: title of the panel."""
    client.gui.configure_theme(
        dark_mode=False,
        show_logo=False,
        show_share_button=False,
        control_width="medium",
        brand_color=BRAND_COLOUR,
    )
    client.scene.set_background_image(np.full((1, 1, 3), BACKGROUND, np.uint8), "png")
    client.gui.set_panel_label(name)
    client.gui.main_panel.dock_right()

    width, height = client.camera.image_width, client.camera.image_height
    is_phone = width < height
    target = PHONE_TARGET if is_phone else CAMERA_TARGET
    # The skin and what stands beside it fill the width that the panels leave.
    free_width = width if is_phone else max(width - LEFT_WIDTH - RIGHT_WIDTH, 0.3 * width)
    distance = max(MIN_CAMERA_DISTANCE, DISTANCE_PER_ASPECT * height / free_width)
    client.camera.position = target + distance * (CAMERA_POSITION - CAMERA_TARGET)
    client.camera.look_at = target
