"""The page of the browser view: the skin in 3-D, controls, one cube's plots and numbers.

It knows viser but not ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.defaults import CONTACT_PRESSURE
from ..core.scene import CubePoses, Newest
from ..elastic.surface import Contact, Surface
from . import markup
from .charts import Charts
from .controls import ColourControls, ReplayControls, ReplayState
from .history import History
from .markup import PageStatus
from .scene_3d import LAYERS, SPAN, Scene3D

MOST_POINTS = 5000
"""On the surface layer."""
MOST_POINTS_PER_SIDE = 8
"""Of one cube's patch of it."""
BRAND_COLOUR = (33, 145, 140)
CAMERA_POSITION = (0.12 * SPAN, -0.75 * SPAN, 0.65 * SPAN)
CAMERA_TARGET = (0.0, -0.02 * SPAN, 0.0)


@dataclass(frozen=True)
class Buttons:
    """What the buttons of the page do. They are called in viser's threads and return at once."""

    tare: Callable[[], None]
    clear_tare: Callable[[], None]
    record: Callable[[], None]
    hold: Callable[[], None]
    jump: Callable[[float], None]


class Page:
    """The page of one skin on a viser server.

    `draw` renews the 3-D part, `write` the numbers and plots.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        names: Sequence[str],
        poses: CubePoses,
        depth: float,
        buttons: Buttons,
    ) -> None:
        """name: of the skin; names: of its cubes; depth: from their centres to the surface, m."""
        self._server = server
        self._names = list(names)
        points_per_side = np.clip(np.sqrt(MOST_POINTS / len(names)), 2, MOST_POINTS_PER_SIDE)
        self._surface = Surface(poses, depth, int(points_per_side))
        self._contact: Contact | None = None
        self._paused = False
        self._written = 0
        _set_up(server, name)
        self._scene = Scene3D(server.scene, poses, self._surface, self._choose)
        self._make_controls(server.gui, buttons)

    @property
    def paused(self) -> bool:
        return self._paused

    def close(self) -> None:
        self._server.scene.remove_click_callback()
        self._server.scene.reset()
        self._server.gui.reset()

    def show_replay(self, replay: ReplayState | None) -> None:
        """Show where a replay is; None: there is none."""
        self._replay.show(replay)

    def draw(self, newest: Newest, health: NDArray[np.integer]) -> None:
        """The skin in 3-D."""
        with self._server.atomic():
            self._scene.draw(self._colours.quantity, self._colours.top, newest, health)

    def write(
        self,
        newest: Newest,
        health: NDArray[np.integer],
        rate: NDArray[np.float64],
        history: History,
        status: PageStatus,
    ) -> None:
        """The first lines; and the plots and all the numbers in alternate calls.

        Plots and numbers each cost a browser about as much as a picture.
        """
        if not self._paused:
            contacts = self._surface.contacts(newest.believed(health), CONTACT_PRESSURE)
            self._contact = contacts[0] if contacts else None
        held = self._paused or self._replay.held
        hertz = float(np.fmax.reduce(rate, axis=None, initial=0.0))
        self._headline.content = markup.headline(
            health, hertz, self._contact, held, status.recording
        )
        self._action.content = markup.action_line(status.action)
        if self._paused:
            return
        self._scene.show_contact(self._contact)
        cube = self._scene.selected
        self._written += 1
        if self._written % 2:
            self._charts.draw(*history.of(cube))
            return
        self._colours.write_legend(self._scene.top)
        self._numbers.content = markup.numbers(newest, cube, health[cube], rate[cube])
        self._health.content = markup.conditions(self._names, health, status.links)

    def _make_controls(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        """In the order in which they stand on the page."""
        self._headline = gui.add_html("")
        self._make_buttons(gui, buttons)
        self._action = gui.add_html("")
        self._replay = ReplayControls(gui, buttons.hold, buttons.jump)
        self._colours = ColourControls(gui, self._quantity_changed)
        layers = gui.add_button_group("show", LAYERS)

        @layers.on_click
        def _(_: object) -> None:
            self._scene.shown ^= {layers.value} & set(LAYERS)

        selected = self._names[self._scene.selected]
        self._cube = gui.add_dropdown("cube", self._names, initial_value=selected)

        @self._cube.on_update
        def _(_: object) -> None:
            # A browser may send any text.
            if self._cube.value in self._names:
                self._scene.selected = self._names.index(self._cube.value)

        with gui.add_folder("numbers"):
            self._numbers = gui.add_html("")
        with gui.add_folder("last 10 s"):
            self._charts = Charts(gui)
        with gui.add_folder("health"):
            self._health = gui.add_html("")

    def _make_buttons(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        actions = {
            "pause": self._toggle_pause,
            "tare": buttons.tare,
            "clear tare": buttons.clear_tare,
            "record": buttons.record,
        }
        group = gui.add_button_group("", tuple(actions))

        @group.on_click
        def _(_: object) -> None:
            action = actions.get(group.value)
            if action is not None:
                action()

    def _toggle_pause(self) -> None:
        self._paused = not self._paused

    def _quantity_changed(self) -> None:
        """The range of another quantity does not follow on that of the last one."""
        self._scene.top = 0.0

    def _choose(self, cube: int) -> None:
        self._cube.value = self._names[cube]  # type: ignore[misc]  # viser's handle has a setter


class WaitingPage:
    """What the page shows before there is a skin."""

    def __init__(self, server: viser.ViserServer, text: str) -> None:
        _set_up(server, "no skin yet")
        self._text: viser.GuiMarkdownHandle | None = server.gui.add_markdown(text)

    def close(self) -> None:
        """Safe to call twice."""
        if self._text is not None:
            self._text.remove()
            self._text = None


def _set_up(server: viser.ViserServer, name: str) -> None:
    """Colours, panel and camera of a page."""
    server.gui.configure_theme(
        dark_mode=True,
        show_logo=False,
        show_share_button=False,
        control_width="large",
        brand_color=BRAND_COLOUR,
    )
    server.gui.set_panel_label(name)
    server.gui.main_panel.dock_right()
    server.initial_camera.position = CAMERA_POSITION
    server.initial_camera.look_at = CAMERA_TARGET
