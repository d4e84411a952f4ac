"""The page of the browser view: the skin in 3-D, controls, one cube's plots and numbers. Knows
viser, not ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Protocol

import numpy as np
import viser
from viser import uplot

from ..core import scene
from ..core.defaults import CONTACT_PRESSURE
from ..core.scene import QUANTITIES, CubePoses, Newest
from ..elastic.surface import Contact, Surface
from . import markup
from .history import History
from .markup import Facts
from .scene_3d import LAYERS, SPAN, Scene3D

STEP_S = 0.1
MOST_POINTS = 5000
"""Of the field's carpet."""
PLOTS = (
    ("normal stress / kPa", 1e-3, ("xx", "yy", "zz")),
    ("shear / kPa", 1e-3, ("zx", "yz", "xy")),
    ("gradient / kPa/mm", 1e-6, ("zz_x", "zz_y", "zz_z")),
    ("residual / σ", 1.0, ("residual",)),
)
TIME = uplot.Scale(time=False, auto=False, range=(-10.0, 0.0))
RENEW = 20
"""After how many `write` all charts are made anew."""
STROKES = ("#4dabf7", "#ffa94d", "#69db7c")
DASHES = ((), (6, 3), (2, 3))


@dataclass
class Buttons:
    """What the page's buttons do; each returns at once. Called in viser's threads."""

    tare: Callable[[], None]
    clear_tare: Callable[[], None]
    record: Callable[[], None]
    hold: Callable[[], None]
    jump: Callable[[float], None]


class Replay(Protocol):
    """How far a replay is, as ReplayState.msg says."""

    position: float
    length: float
    paused: bool


class Page:
    """One skin on a viser server. `draw` is the picture, `write` the numbers and plots; both for
    the newest rows."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        names: Sequence[str],
        places: CubePoses,
        depth: float,
        buttons: Buttons,
    ) -> None:
        self._server, self._names = server, list(names)
        self._surface = Surface(
            places, depth, int(np.clip(np.sqrt(MOST_POINTS / len(names)), 2, 8))
        )
        self._load: Contact | None = None
        server.gui.configure_theme(
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
            control_width="large",
            brand_color=(33, 145, 140),
        )
        server.gui.set_panel_label(name)
        server.gui.main_panel.dock_right()
        server.initial_camera.position = (0.12 * SPAN, -0.75 * SPAN, 0.65 * SPAN)
        server.initial_camera.look_at = (0.0, -0.02 * SPAN, 0.0)
        self._stage = Scene3D(server.scene, places, self._surface, self._pick)
        self._make_controls(server.gui, buttons)

    @property
    def paused(self) -> bool:
        return self._paused

    def close(self) -> None:
        self._server.scene.remove_click_callback()
        self._server.scene.reset()
        self._server.gui.reset()

    def steer(self, replay: Replay | None) -> None:
        """Show where a replay is, or that there is none."""
        self._held = replay is not None and replay.paused
        self._replay.visible = replay is not None
        if replay is not None:
            self._place.max = max(replay.length, STEP_S)
            self._place.value = min(replay.position, self._place.max)  # type: ignore[misc]  # As below.
            self._hold.label = "play" if replay.paused else "hold"

    def _make_controls(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        self._head = gui.add_html("")
        self._paused = self._held = False
        row = gui.add_button_group("", ("pause", "tare", "clear tare", "record"))

        @row.on_click
        def _(_: object) -> None:
            if row.value == "pause":
                self._paused = not self._paused
            else:
                {"tare": buttons.tare, "clear tare": buttons.clear_tare, "record": buttons.record}[
                    row.value
                ]()

        self._action = gui.add_html("")
        with gui.add_folder("replay", visible=False) as self._replay:
            self._place = gui.add_slider("s", 0.0, 1.0, STEP_S, 0.0)
            self._hold = gui.add_button("hold")
        self._hold.on_click(lambda _: buttons.hold())
        # What `steer` shows has no client.
        self._place.on_update(
            lambda event: buttons.jump(self._place.value) if event.client else None
        )
        self._quantity = gui.add_dropdown("colour", [q.label for q in QUANTITIES.values()])
        self._quantity.on_update(lambda _: setattr(self._stage, "top", 0.0))
        self._range = gui.add_number("range (0: auto)", 0.0, min=0.0, step=0.1)
        self._legend = gui.add_html("")
        layers = gui.add_button_group("show", LAYERS)

        @layers.on_click
        def _(_: object) -> None:
            self._stage.layers ^= {layers.value}

        self._chosen = gui.add_dropdown(
            "cube", self._names, initial_value=self._names[self._stage.selected]
        )

        @self._chosen.on_update
        def _(_: object) -> None:
            self._stage.selected = self._names.index(self._chosen.value)

        with gui.add_folder("numbers"):
            self._numbers = gui.add_html("")
        with gui.add_folder("last 10 s"):
            empty = np.array([0.0])
            self._plots = []
            self._spans, self._written = [(0.0, 1.0) for _ in PLOTS], 0
            scales = {"x": TIME, "y": uplot.Scale(auto=False, range=(0.0, 1.0))}
            for title, _factor, columns in PLOTS:
                lines = [
                    uplot.Series(label=markup.label(name), stroke=stroke, width=1.5, dash=dash)
                    for name, stroke, dash in zip(columns, STROKES, DASHES, strict=False)
                ]
                axes = tuple(
                    uplot.Axis(
                        stroke="#ced4da", grid={"stroke": "#495057", "width": 0.5}, size=size
                    )
                    for size in (34, 46)
                )
                self._plots.append(
                    gui.add_uplot(
                        (empty,) * (1 + len(lines)),
                        (uplot.Series(label="s"), *lines),
                        title=title,
                        height=160,
                        axes=axes,
                        scales=scales,
                        padding=(4, 8, 0, 0),
                    )
                )
        with gui.add_folder("health"):
            self._health = gui.add_html("")

    def _pick(self, cube: int) -> None:
        self._chosen.value = self._names[cube]  # type: ignore[misc]  # Viser's own handle has the setter.

    @property
    def quantity(self) -> scene.Quantity:
        return next(q for q in QUANTITIES.values() if q.label == self._quantity.value)

    def draw(self, newest: Newest, health: np.ndarray) -> None:
        """The skin in 3-D."""
        quantity = self.quantity
        with self._server.atomic():
            self._stage.draw(quantity, self._range.value * quantity.size, newest, health)

    def write(
        self, newest: Newest, health: np.ndarray, rate: np.ndarray, history: History, facts: Facts
    ) -> None:
        """Status, and by turns the plots or all the numbers: a browser pays for each about what a
        picture costs."""
        k = self._stage.selected
        if not self._paused:
            self._load = next(
                iter(self._surface.contacts(newest.believed(health), CONTACT_PRESSURE)), None
            )
        hertz = float(np.nanmax(rate, initial=0.0))
        self._head.content = markup.head(
            health, hertz, self._load, self._paused or self._held, facts.recording
        )
        self._action.content = markup.box(escape(facts.action)) if facts.action else ""
        if self._paused:
            return
        self._stage.show(self._load)
        self._written += 1
        if self._written % 2:
            self._plot(*history.of(k))
            return
        self._legend.content = markup.legend(self.quantity, self._stage.top)
        self._numbers.content = markup.numbers(newest, k, health[k], rate[k])
        self._health.content = markup.conditions(self._names, health, facts.links)

    def _plot(self, times: np.ndarray, lines: np.ndarray) -> None:
        for number, (plot, (_, factor, columns)) in enumerate(zip(self._plots, PLOTS, strict=True)):
            shown = [lines[:, History.COLUMNS.index(name)] * factor for name in columns]
            plot.data = (times, *shown)
            finite = np.concatenate(shown)
            finite = finite[np.isfinite(finite)]
            low, high = _nice(finite.min(initial=0.0), finite.max(initial=0.0))
            # A chart that the page makes before it knows its width has no time axis until its
            # scales change.
            span = low, high + 1e-9 * (high - low) * (self._written // RENEW % 2)
            # uPlot cannot scale by itself where there is NaN.
            if self._spans[number] != span:
                self._spans[number], plot.scales = (
                    span,
                    {"x": TIME, "y": uplot.Scale(auto=False, range=span)},
                )


def _nice(low: float, high: float) -> tuple[float, float]:
    """A range of an axis that holds low .. high and zero, in steps so coarse that it seldom
    changes."""
    size = max(-low, high, 1e-9)
    power = 10.0 ** np.floor(np.log10(size))
    step = power * next(k for k in (1, 2, 5, 10) if k * power >= size * (1 - 1e-9)) / 2
    return float(np.floor(min(low, 0) / step) * step), float(np.ceil(max(high, 0) / step) * step)
