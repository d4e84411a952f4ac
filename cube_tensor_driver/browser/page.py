"""The page of the browser view: the skin in 3-D, controls, plots, and the skin from above.

It knows viser but not ROS. Each browser has a page of its own, with its own settings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.poses import CubePoses
from ..touch.surface import Surface
from . import markup
from .charts import Charts
from .controls import ColourControls, ReplayControls, ReplayState, ShownControls
from .history import History
from .markup import PageStatus
from .moment import Moment
from .scene_3d import SPAN, Colouring, Scene3D
from .top_view import TopView

MOST_POINTS = 5000
"""On the surface."""
MOST_POINTS_PER_SIDE = 12
"""Of one cube's patch of it."""
BRAND_COLOUR = (24, 100, 171)
BACKGROUND = (246, 247, 249)
LEFT_WIDTH = 440.0
RIGHT_WIDTH = 320.0
"""Of the panel with the plots, and of viser's main panel, pixels."""
CAMERA_POSITION = np.array([0.1, -1.0, 1.05]) * SPAN
CAMERA_TARGET = np.array([0.0, -0.04, 0.0]) * SPAN
LOWER_TARGET = np.array([0.0, -0.45, -0.3]) * SPAN
"""For phones: their panels cover the lower part of the picture, the skin is above them."""
NEAREST, NEAREST_WIDTH = 0.95, 0.78
"""How far the camera is, relative to CAMERA_POSITION, where the picture is wide enough; and where
it is not, times its width over its height."""
PAUSE, GO_ON = "pause the page", "go on"
RECORD, STOP = "record", "stop recording"
TARE, CLEAR_TARE = "tare", "undo tare"
NOTE_S = 8.0


@dataclass(frozen=True)
class Buttons:
    """What the buttons of the page do. They are called in viser's threads and return at once."""

    tare: Callable[[], None]
    clear_tare: Callable[[], None]
    record: Callable[[], None]
    hold: Callable[[], None]
    jump: Callable[[float], None]


class ShownSkin:
    """A skin as all pages show it.

    names: of its cubes. surface: with points between the cubes, `depth` m above their centres.
    history: of the last seconds.
    """

    def __init__(
        self, name: str, names: Sequence[str], poses: CubePoses, depth: float, history: History
    ) -> None:
        points_per_side = np.clip(np.sqrt(MOST_POINTS / len(names)), 2, MOST_POINTS_PER_SIDE)
        self.name, self.names, self.poses = name, list(names), poses
        self.surface = Surface(poses, depth, int(points_per_side))
        self.top_view = TopView(names, poses, self.surface)
        self.history = history


class Page:
    """The page of one skin in one browser."""

    def __init__(self, client: viser.ClientHandle, skin: ShownSkin, buttons: Buttons) -> None:
        self._client = client
        self._skin = skin
        self._moment: Moment | None = None
        self._paused = False
        self._complete = False
        self._written = 0
        self._top = 0.0
        self._said = ""
        set_up(client, skin.name)
        self._scene = Scene3D(client.scene, skin.names, skin.poses, skin.surface, self._choose)
        self._make_controls(client.gui, buttons)
        self._make_panel(client.gui)

    @property
    def paused(self) -> bool:
        return self._paused

    def close(self) -> None:
        self._client.scene.remove_click_callback()
        self._client.scene.reset()
        self._client.gui.reset()

    def show_replay(self, replay: ReplayState | None) -> None:
        """Show where a replay is; None: there is none."""
        self._replay.show(replay)

    def show(
        self, moment: Moment, rate: NDArray[np.float64], status: PageStatus, with_numbers: bool
    ) -> None:
        """All that is shown of a moment; with_numbers: also what changes less often.

        rate: (N,) rows per second. While the page is paused it keeps the moment it has.
        """
        with self._client.atomic():
            if not self._paused or self._moment is None:
                self._moment = moment
                self._draw(moment)
            self._write_first_lines(self._moment, rate, status)
            if self._paused and not self._complete:
                # So that all that is shown while paused is of one moment.
                self._write_plots()
                self._write_numbers(self._moment, rate, status)
                self._complete = True
            elif with_numbers and not self._paused:
                self._write(self._moment, rate, status)

    def _draw(self, moment: Moment) -> None:
        quantity, wanted = self._colours.quantity, self._colours.top
        self._colouring = Colouring.of(moment, self._skin.surface, quantity, wanted, self._top)
        self._top = self._colouring.top
        self._scene.draw(moment, self._colouring)

    def _write_first_lines(
        self, moment: Moment, rate: NDArray[np.float64], status: PageStatus
    ) -> None:
        held = self._paused or self._replay.held
        hertz = float(np.fmax.reduce(rate, axis=None, initial=0.0))
        line = markup.headline(moment.health, hertz, moment.contact, held, status.recording)
        if line != self._headline.content:
            self._headline.content = line
        view = (GO_ON if self._paused else PAUSE, STOP if status.recording else RECORD)
        if tuple(self._view.options) != view:
            self._view.options = view
        if status.action != self._said:
            self._said = status.action
            self._action.content = markup.action_line(status.action)
            self._client.add_notification(
                status.title, status.action, auto_close_seconds=NOTE_S, color=status.colour
            )

    def _write(self, moment: Moment, rate: NDArray[np.float64], status: PageStatus) -> None:
        """Plots and numbers in alternate calls: each costs a browser as much as a picture."""
        self._written += 1
        if self._written % 2:
            self._write_plots()
        else:
            self._write_numbers(moment, rate, status)

    def _write_plots(self) -> None:
        self._charts.draw(self._skin.history, self._scene.selected)

    def _write_numbers(self, moment: Moment, rate: NDArray[np.float64], status: PageStatus) -> None:
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
        """The main panel, in the order in which it stands on the page."""
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
            ShownControls(gui, self._scene.shown)
        with gui.add_folder("health"):
            self._health = gui.add_html("")

    def _make_panel(self, gui: viser.GuiApi) -> None:
        """The second panel: plots, and the skin from above."""
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
        def _(event: viser.GuiEvent) -> None:
            # A browser may send any text.
            action = actions.get(str(event.target.value))
            if action is not None:
                action()

    def _toggle_pause(self) -> None:
        self._paused, self._complete = not self._paused, False

    def _quantity_changed(self) -> None:
        """The range of another quantity does not follow on that of the last one."""
        self._top = 0.0

    def _choose(self, cube: int) -> None:
        # viser's handle has a setter
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
        self._text.remove()
        self._label.remove()


def set_up(client: viser.ClientHandle, name: str) -> None:
    """Colours, panel and camera of a page."""
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
    narrow = width < height
    target = LOWER_TARGET if narrow else CAMERA_TARGET
    # The skin and what stands beside it fill the width that the panels leave.
    free = width if narrow else max(width - LEFT_WIDTH - RIGHT_WIDTH, 0.3 * width)
    far = max(NEAREST, NEAREST_WIDTH * height / free)
    client.camera.position = target + far * (CAMERA_POSITION - CAMERA_TARGET)
    client.camera.look_at = target
