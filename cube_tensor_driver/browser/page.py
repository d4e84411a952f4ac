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
"""Approximate maximum of the number of points of the skin's surface at which the field (pressure
and shear between the cubes) is drawn."""

MAX_POINTS_PER_SIDE = 12
"""Maximum number of points of the surface along one side of the square patch around a cube."""

BRAND_COLOUR = (24, 100, 171)
BACKGROUND = (246, 247, 249)

LEFT_WIDTH = 440.0
"""Width, in pixels, of the panel with the plots at the left of the page."""

RIGHT_WIDTH = 320.0
"""Width, in pixels, of viser's main panel (with the controls) at the right of the page."""

CAMERA_POSITION = np.array([0.1, -1.0, 1.05]) * SPAN
"""Position of the camera in the scene, for a picture that is a little higher than wide.

The origin of the scene is the centre of the skin, and `SPAN` is the length of its longest side.
"""

CAMERA_TARGET = np.array([0.0, -0.04, 0.0]) * SPAN
"""Point of the scene at which the camera looks; the origin is the centre of the skin."""

PHONE_TARGET = np.array([0.0, -0.45, -0.3]) * SPAN
"""Point of the scene at which the camera looks on a phone.

It is in front of the skin, which therefore appears in the upper part of the picture; the panels
cover the lower part.
"""

MIN_CAMERA_DISTANCE = 0.95
"""Minimum distance from the camera to the point at which it looks, relative to the distance from
`CAMERA_POSITION` to `CAMERA_TARGET`."""

DISTANCE_PER_ASPECT = 0.78
"""Distance of the camera, relative to the default one, for a picture as wide as it is high.

The distance is divided by the ratio of free width (between the panels) to height, because the
camera must be further away to show the whole skin in a narrow picture.
"""

PAUSE = "pause the page"
GO_ON = "go on"
RECORD = "record"
STOP = "stop recording"
TARE = "tare"
CLEAR_TARE = "undo tare"

NOTE_S = 8.0
"""Time, in seconds, for which the page shows a note about an action of the user."""


@dataclass(frozen=True)
class Buttons:
    """Functions that the buttons of the page call, in threads of viser. They return at once.

    Attributes:
        tare: Takes the present load as zero load.
        clear_tare: Undoes all tares.
        record: Begins a recording, or ends the present one.
        hold: Stops the replay, or lets it continue.
        jump: Lets the replay jump to a position, in s after the start of the bag.
    """

    tare: Callable[[], None]
    clear_tare: Callable[[], None]
    record: Callable[[], None]
    hold: Callable[[], None]
    jump: Callable[[float], None]


class ShownSkin:
    """The skin that is shown, with everything that the pages of all browsers share.

    Attributes:
        name: Name of the skin.
        names: Names of its cubes.
        poses: Poses of its cubes in the parent frame, in m.
        surface: Grid of points around the cubes at which the field (pressure and shear) is drawn.
        top_view: Drawing of the skin from above.
        history: Values of all cubes in the last seconds.
    """

    def __init__(
        self, name: str, names: Sequence[str], poses: CubePoses, depth: float, history: History
    ) -> None:
        """Prepare the points of the field and the drawing from above.

        Args:
            name: Name of the skin.
            names: Names of its cubes.
            poses: Poses of its cubes in the parent frame, in m.
            depth: Distance from the centres of the cubes to the surface of the skin, in m.
            history: Buffer for the values of the last seconds.
        """
        # A large skin gets fewer points per cube, so that all have about `MAX_SURFACE_POINTS`.
        points_per_side = np.sqrt(MAX_SURFACE_POINTS / len(names))
        points_per_side = np.clip(points_per_side, 2, MAX_POINTS_PER_SIDE)
        self.name, self.names, self.poses = name, list(names), poses
        self.surface = Surface(poses, depth, int(points_per_side))
        self.top_view = TopView(names, poses, self.surface)
        self.history = history


class Page:
    """The page that shows a skin in one browser, with the settings of that browser's user."""

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
        """Whether the user has stopped the updates of this page (not the replay)."""
        return self._paused

    def close(self) -> None:
        """Remove all objects of the scene and all controls from the browser."""
        self._client.scene.remove_click_callback()
        self._client.scene.reset()
        self._client.gui.reset()

    def show_replay(self, replay: ReplayPosition | None) -> None:
        """Show position and state of a replay.

        Args:
            replay: State of the replay; None: there is no replay, and its controls are hidden.
        """
        self._replay.show(replay)

    def show(
        self,
        moment: Moment,
        rate: Array,
        status: PageStatus,
        with_numbers: bool,
    ) -> None:
        """Show the values of one instant; a paused page keeps those of the instant it shows.

        Args:
            moment: Values, field and contacts at the instant.
            rate: (N,) number of rows (measurements) per second of each cube.
            status: Links, recording, and result of the user's last action.
            with_numbers: Whether to update numbers and plots as well as the 3-D view.
        """
        # `atomic` makes the browser apply all changes at once; otherwise it could show the field
        # of this instant with the cubes of the one before.
        with self._client.atomic():
            if not self._paused or self._moment is None:
                self._moment = moment
                self._draw(moment)
            self._write_first_lines(self._moment, rate, status)
            if self._paused and not self._is_complete:
                # Plots and numbers are updated once more after the pause began, so that they
                # belong to the same instant as the 3-D view.
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
        # viser sends each assignment to the browser, even if the text is the same.
        if line != self._headline.content:
            self._headline.content = line
        # The text of each button tells what the next press will do.
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
        """Update the plots in one call and the numbers in the next.

        Each of the two takes a browser as much time as a picture of the 3-D view.

        Args:
            moment: Values, field and contacts at the instant.
            rate: (N,) number of rows (measurements) per second of each cube.
            status: Links, recording, and result of the user's last action.
        """
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
        """Add the controls to the main panel, from top to bottom.

        Args:
            gui: The controls of one browser.
            buttons: Functions that the buttons call.
        """
        # A style sheet applies to the whole page, wherever it is inserted.
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
            # A browser may send any text, so it is compared with the names.
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
        """Add the second panel with two tabs: plots over time, and the skin from above."""
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
            # A browser may send any text; one that is not the text of a button does nothing.
            action = actions.get(str(event.target.value))
            if action is not None:
                action()

    def _toggle_pause(self) -> None:
        self._paused, self._is_complete = not self._paused, False

    def _quantity_changed(self) -> None:
        """Forget the automatic range of the colours, which belongs to another quantity."""
        self._top = 0.0

    def _choose(self, cube: int) -> None:
        # viser's handle has a setter for the value, which its type annotations do not declare.
        self._cube.value = self._skin.names[cube]  # type: ignore[misc]


class WaitingPage:
    """The page that a browser shows while no skin is published."""

    def __init__(self, client: viser.ClientHandle, text: str) -> None:
        set_up(client, "no skin yet")
        self._text = client.gui.add_html(markup.PHONE_STYLE + markup.box(text))
        self._label = client.scene.add_label(
            "/waiting", "Waiting for a skin …", anchor="center-center", font_screen_scale=1.6
        )

    def close(self) -> None:
        """Remove the two texts of this page from the browser."""
        self._text.remove()
        self._label.remove()


def set_up(client: viser.ClientHandle, name: str) -> None:
    """Set the colours, the main panel and the camera of a browser.

    Args:
        client: The browser.
        name: Title of the main panel.
    """
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
    # The skin, the scale bar and the axes fill the width that the panels leave free.
    free_width = width if is_phone else max(width - LEFT_WIDTH - RIGHT_WIDTH, 0.3 * width)
    distance = max(MIN_CAMERA_DISTANCE, DISTANCE_PER_ASPECT * height / free_width)
    client.camera.position = target + distance * (CAMERA_POSITION - CAMERA_TARGET)
    client.camera.look_at = target
