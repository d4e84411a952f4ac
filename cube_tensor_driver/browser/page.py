# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The page of the browser view: the skin in 3-D, controls and plots.

It uses viser but not ROS. Each browser has a page of its own, with its own settings.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from html import escape
from typing import cast

import numpy as np
import viser
from numpy.typing import ArrayLike

from ..views.scene import Quantity, Ranges
from . import markup
from .charts import Charts
from .controls import FIRST_PARTS, PARTS, ColourControls, ReplayControls
from .history import History
from .markup import PageStatus
from .scan import Scan
from .scene_3d import SPAN, Update
from .update import ShownSkin, ViewSettings, build_update

BRAND_COLOUR = (24, 100, 171)
"""Colour of buttons and check boxes, as red, green and blue from 0 to 255."""
BACKGROUND = (246, 247, 249)
"""Colour behind the skin, as red, green and blue from 0 to 255."""

LEFT_WIDTH = 400.0
"""Width, in pixels, of the panel with the plots at the left of the page."""

RIGHT_WIDTH = 320.0
"""Width, in pixels, of viser's main panel (with the controls) at the right of the page."""

MIN_FREE_SHARE = 0.5
"""Minimum share of the width of the page that the panels leave free for the skin.

In a browser that is too narrow for that, the panel with the plots is folded away at first.
"""

CAMERA_POSITION = np.array([0.1, -1.0, 1.05]) * SPAN
"""Position of the camera in the scene, for a picture that is a little higher than wide.

The origin of the scene is the centre of the skin, and `SPAN` is the length of its longest side.
"""

CAMERA_TARGET = np.array([0.0, -0.04, 0.0]) * SPAN
"""Point of the scene at which the camera looks; the origin is the centre of the skin."""

INCLINED = "inclined"
"""Name of the direction from which the camera looks at first."""

CAMERA_DIRECTIONS = {
    INCLINED: CAMERA_POSITION - CAMERA_TARGET,
    # If the camera were exactly above the skin, it would be undefined which side of the skin is
    # up in the picture.
    "from above": np.array([0.0, -0.01, 1.4]) * SPAN,
}
"""Name of a direction of view -> vector (3,), in the coordinates of the scene. It leads from the
camera's target (the point at which the camera looks) to the camera."""

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
"""Text of the button that stops the updates of the page."""
GO_ON = "go on"
"""Text of the button that lets the updates of the page continue."""
RECORD = "record"
"""Text of the button that begins to record a bag."""
STOP = "stop recording"
"""Text of the button that ends the recording."""
TARE = "tare"
"""Text of the button that takes the present load as zero load."""
CLEAR_TARE = "undo tare"
"""Text of the button that undoes all tares."""
HOLD = "hold the replay"
"""Action of a user: the replay of a bag pauses, or goes on if it was paused."""
JUMP = "jump"
"""Action of a user: the replay of a bag jumps to another time."""

Act = Callable[..., None]
"""Function that a page calls, in threads of viser, when its user wants something.

Its first argument is the action: `TARE`, `CLEAR_TARE`, `RECORD`, `STOP`, `HOLD` or `JUMP`. For
`JUMP` the second argument is a function that returns a time in the replay, in s after the start of
the bag. The call returns at once; the action is done later, in the thread that shows the page.
"""

NOTE_S = 8.0
"""Time, in seconds, for which the page shows a note about an action of the user."""


class PageLayout:
    """Arrangement of the page for the size that a browser has when it opens the page.

    Attributes:
        is_folded: Whether the panel with the plots is folded away at first.
        target: (3,) point of the scene at which the camera looks.
        distance: Distance of the camera, relative to that of `CAMERA_POSITION`.
    """

    def __init__(self, width: int, height: int) -> None:
        """Choose the arrangement of the page for the width and height of a browser, in pixels."""
        is_phone = width < height
        self.target = PHONE_TARGET if is_phone else CAMERA_TARGET
        free = width - LEFT_WIDTH - RIGHT_WIDTH
        self.is_folded = is_phone or free < MIN_FREE_SHARE * width
        # On a phone the panels cover the lower part of the picture, and not its sides.
        if is_phone:
            free = width
        elif self.is_folded:
            free = width - RIGHT_WIDTH
        distance = DISTANCE_PER_ASPECT * height / max(free, 1.0)
        self.distance = max(MIN_CAMERA_DISTANCE, distance)


class Page:
    """The page that shows a skin in one browser, with the settings of that browser's user.

    Attributes:
        replay: Controls of a replay.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        layout: PageLayout,
        skin: ShownSkin,
        act: Act,
    ) -> None:
        self._client, self._layout, self._skin = client, layout, skin
        self._scan: Scan | None = None
        self._frozen: tuple[Scan, History] | None = None
        self._paused = False
        self._ranges = self._ranges_before = Ranges()
        self._quantity: Quantity | None = None
        self._cube = skin.scene.first_cube
        self._noted = ""
        self._sent: dict[tuple[str, str], object] = {}
        set_up(client, layout, skin.name)
        self._objects = skin.scene.add_to(client.scene, self._choose)
        self._make_controls(client.gui, act)
        self._make_panel(client.gui)

    def show(
        self,
        scan: Scan,
        history: History,
        status: PageStatus,
    ) -> None:
        """Show a scan, or again the scan at which the user paused the page.

        A paused page still follows its user's choice of colour, cube and parts of the view.

        Args:
            scan: The values of all cubes at the newest instant.
            history: Values of all cubes in the last seconds; the newest are those of the scan.
            status: Recording, and result of the user's last action.
        """
        # A paused page keeps the first scan that it gets after the pause began. Its history is
        # copied, because the pages of other browsers still add to the common one.
        if not self._paused:
            self._frozen = None
        elif self._frozen is None:
            self._frozen = scan, copy.deepcopy(history)
        scan, history = self._frozen or (scan, history)
        # While no new values arrive, as in a replay that is held, the automatic ranges of colours
        # and arrows do not change.
        shown = self._scan
        if shown is None or not np.array_equal(shown.values, scan.values, equal_nan=True):
            self._ranges_before = self._ranges
        self._scan = scan
        self._show_status(status)
        update, self._ranges = build_update(
            self._skin,
            scan,
            history,
            self._read_settings(history, status),
            self._ranges_before,
        )
        self.send(update)

    def send(self, update: Update) -> None:
        """Send the changed properties of all objects to the browser, as one update.

        Args:
            update: Name of an object on the page -> its properties.
        """
        # `atomic` makes the browser apply all changes at once. Otherwise it could show numbers of
        # one instant beside the picture of another one.
        with self._client.atomic():
            for name, properties in update.items():
                for key, value in properties.items():
                    # viser sends most assignments to the browser, even if the value is the same.
                    if not is_same(value, self._sent.get((name, key))):
                        self._sent[name, key] = value
                        setattr(self._objects[name], key, value)

    def _read_settings(self, history: History, status: PageStatus) -> ViewSettings:
        """Return what the user has chosen, as the browser has reported it.

        Args:
            history: Values of all cubes in the last seconds, which the charts draw.
            status: States whether a bag is being recorded.
        """
        quantity = self._colours.quantity
        if quantity is not self._quantity:
            # The old range is that of another quantity, so the automatic range starts anew.
            self._quantity = quantity
            self._ranges_before = self._ranges_before._replace(colours=0.0)
        return ViewSettings(
            quantity=quantity,
            fixed_top=self._colours.fixed_top,
            cube=self._cube,
            parts={name for name, box in self._parts.items() if box.value},
            charts=self._charts.choose(history, self._cube),
            is_paused=self._paused or self.replay.is_held,
            is_recording=status.recording,
        )

    def _show_status(self, status: PageStatus) -> None:
        """Show the result of the last action, and what the next press of a button will do."""
        # Each button has the text of what it does next.
        view = (GO_ON if self._paused else PAUSE, STOP if status.recording else RECORD)
        if tuple(self._view.options) != view:
            self._view.options = view
        if status.action != self._noted:
            self._noted = status.action
            self._action.content = markup.put_in_box(escape(status.action))
            self._client.add_notification(
                status.title,
                status.detail,
                auto_close_seconds=NOTE_S,
                color=status.colour,
            )

    def _make_controls(self, gui: viser.GuiApi, act: Act) -> None:
        """Add the controls to the main panel, from top to bottom.

        Args:
            gui: The controls of one browser.
            act: Function that is called when the user wants something.
        """
        objects = self._objects
        # A style sheet applies to the whole page, wherever it is inserted.
        gui.add_html(markup.STYLE)
        objects["headline"] = gui.add_html("")
        self._make_buttons(gui, act)
        self._action = gui.add_html("")
        self.replay = ReplayControls(
            gui,
            partial(act, HOLD),
            partial(act, JUMP),
        )
        self._colours = ColourControls(gui)
        objects["colour"] = self._colours.list
        objects["legend"] = self._colours.legend
        names = self._skin.names
        self._cube_list = gui.add_dropdown(
            "cube",
            names,
            initial_value=names[self._cube],
        )

        @self._cube_list.on_update
        def _(_: object) -> None:
            # A browser may send any text, so it is compared with the names.
            if self._cube_list.value in names:
                self._cube = names.index(self._cube_list.value)

        with gui.add_folder("numbers of the chosen cube"):
            objects["numbers"] = gui.add_html("")
        with gui.add_folder("contacts"):
            objects["contact list"] = gui.add_html("")
        with gui.add_folder("what is drawn"):
            objects["meaning"] = gui.add_html("")
            self._parts = {
                name: gui.add_checkbox(text, name in FIRST_PARTS) for name, text in PARTS.items()
            }
            view = gui.add_button_group("camera", tuple(CAMERA_DIRECTIONS))

        @view.on_click
        def _(_: object) -> None:
            place_camera(self._client, self._layout, str(view.value))

        with gui.add_folder("health"):
            objects["health"] = gui.add_html("")

    def _make_panel(self, gui: viser.GuiApi) -> None:
        """Add the second panel, with plots over time."""
        panel = gui.add_panel()
        plots = panel.add_tab("plots of 10 s", viser.Icon.CHART_LINE)
        self._charts = Charts(gui, plots, self._skin.names)
        for number, (one, plot) in enumerate(
            zip(self._charts.lists, self._charts.plots, strict=True)
        ):
            self._objects |= {f"chart list {number}": one, f"chart {number}": plot}
        panel.dock_left()
        panel.set_width(LEFT_WIDTH)
        if self._layout.is_folded:
            panel.minimize()

    def _make_buttons(self, gui: viser.GuiApi, act: Act) -> None:
        self._view = gui.add_button_group("view", (PAUSE, RECORD))
        zero = gui.add_button_group(
            "zero",
            (TARE, CLEAR_TARE),
            hint="tare takes the present load as zero load",
        )

        @self._view.on_click
        @zero.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            label = str(event.target.value)
            if label in (PAUSE, GO_ON):
                self._paused = not self._paused
            else:
                act(label)

    def _choose(self, cube: int) -> None:
        # viser's handle has a setter for the value, which its type annotations do not declare.
        self._cube_list.value = self._skin.names[cube]  # type: ignore[misc]


def is_same(one: object, other: object) -> bool:
    """Return whether two values of a property are equal: numbers, texts, arrays, tuples of them."""
    # Comparing long texts as arrays would take much longer.
    if isinstance(one, str):
        return bool(one == other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(is_same, one, other))
    # numpy compares any two objects, although its annotations name only some types.
    return np.array_equal(cast(ArrayLike, one), cast(ArrayLike, other))


def show_waiting(
    client: viser.ClientHandle,
    layout: PageLayout,
    text: str,
) -> None:
    """Show a text in a browser while no skin is published.

    Args:
        client: The browser.
        layout: Arrangement of the page in this browser.
        text: The text, as HTML.
    """
    set_up(client, layout, "cube_tensor_driver")
    client.gui.add_html(markup.STYLE + markup.put_in_box(text))
    client.scene.add_label(
        "/waiting",
        "Waiting for a skin …",
        anchor="center-center",
        font_screen_scale=1.6,
    )


def clear(client: viser.ClientHandle) -> None:
    """Remove all objects of the scene and all controls from a browser."""
    client.scene.remove_click_callback()
    client.scene.reset()
    client.gui.reset()


def set_up(
    client: viser.ClientHandle,
    layout: PageLayout,
    name: str,
) -> None:
    """Set the colours, the main panel and the camera of a browser.

    Args:
        client: The browser.
        layout: Arrangement of the page in this browser.
        name: Title of the main panel.
    """
    client.gui.configure_theme(
        dark_mode=False,
        show_logo=False,
        show_share_button=False,
        control_width="medium",
        brand_color=BRAND_COLOUR,
    )
    pixel = np.full((1, 1, 3), BACKGROUND, np.uint8)
    client.scene.set_background_image(pixel, "png")
    client.gui.set_panel_label(name)
    client.gui.main_panel.dock_right()
    place_camera(client, layout, INCLINED)


def place_camera(
    client: viser.ClientHandle,
    layout: PageLayout,
    direction: str,
) -> None:
    """Place the camera of a browser in one of the `CAMERA_DIRECTIONS` from the skin.

    Args:
        client: The browser.
        layout: Arrangement of the page, with the target and the distance of the camera.
        direction: Name of the direction. With an unknown name nothing is done.
    """
    if direction not in CAMERA_DIRECTIONS:  # a browser may send any text
        return
    camera = client.camera
    camera.position = layout.target + layout.distance * CAMERA_DIRECTIONS[direction]
    camera.look_at = layout.target
