"""The page of the browser view: the skin in 3-D, controls, one cube's plots and numbers. Knows viser, not ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Protocol

import numpy as np
import viser
from viser import uplot

from ..core import scene
from ..core.scene import QUANTITIES, Newest, Places
from ..elastic.surface import Contact, Surface
from . import markup
from .carpet import Carpet, light
from .history import History
from .markup import Facts

SPAN = 2.0
"""The longest side of a skin in the scene: cameras and clipping planes of viewers are made for metres, skins for cm."""
LEAST_PA = 300.0
"""Pressure at the cubes that counts as contact."""
STEP_S = 0.1
MOST_POINTS = 5000
"""Of the field's carpet."""
LEAST_ARROW = SPAN / 16
"""Arrows are drawn as if the pitch were at least this: of a thousand cubes the direction of a touch is still seen."""
DIM = 0.5
"""The carpet's colours beside the cubes', which stand out by it."""
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
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                       [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
AMBIENT, DIRECT = 2.0, 1.4
WHITE, GOLD, PULL, PUSH = light(np.array([(0.92, 0.92, 0.92), (1.0, 0.6, 0.15), (1.0, 0.35, 0.27), (0.35, 0.59, 1.0)]))


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
    """One skin on a viser server. `draw` is the picture, `write` the numbers and plots; both for the newest rows."""

    def __init__(self, server: viser.ViserServer, name: str, names: Sequence[str], places: Places, depth: float,
                 buttons: Buttons) -> None:  # fmt: skip
        self._server, self._names = server, list(names)
        self._surface = Surface(places, depth, int(np.clip(np.sqrt(MOST_POINTS / len(names)), 2, 8)))
        size = np.ptp(places.position, axis=0).max() + places.pitch
        self._unit = SPAN / size
        centre = (places.position.min(axis=0) + places.position.max(axis=0)) / 2
        self._centre = centre
        self.selected = int(((places.position - centre) ** 2).sum(axis=1).argmin())
        self._places = Places((places.position - centre) * self._unit, places.rotation, places.half_side * self._unit)
        self._pitch = places.pitch * self._unit
        self._arrow = max(self._pitch, LEAST_ARROW)
        self._top = self._longest = self._steepest = 0.0
        self._load: Contact | None = None
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large",
                                   brand_color=(33, 145, 140))  # fmt: skip
        server.gui.set_panel_label(name)
        server.gui.main_panel.dock_right()
        server.initial_camera.position = (0.12 * SPAN, -0.75 * SPAN, 0.65 * SPAN)
        server.initial_camera.look_at = (0.0, -0.02 * SPAN, 0.0)
        self._make_scene(server.scene)
        self._make_controls(server.gui, buttons)

    @property
    def paused(self) -> bool:
        return self._paused

    def close(self) -> None:
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

    def _make_scene(self, to: viser.SceneApi) -> None:
        places, n = self._places, len(self._names)
        # No shadows, no reflections, and as much light as shows colours as the legend has them; a machine without a
        # graphics card shall do.
        to.configure_default_lights(enabled=False)
        to.configure_environment_map(None)
        to.add_light_ambient("/light/all", intensity=AMBIENT)
        to.add_light_directional("/light/above", intensity=DIRECT, position=(-0.4, -0.6, 1.0))
        turns = self._turns = scene.turns(places.rotation)
        grey = np.full((n, 3), 90, np.uint8)
        self._cubes = to.add_batched_meshes_simple(
            "/cubes", CUBE, CUBE_FACES, turns, places.position, batched_scales=places.half_side,
            batched_colors=grey, flat_shading=True, lod="off", cast_shadow=False, receive_shadow=False)  # fmt: skip
        self._cubes.on_click(self._pick)
        points = (self._surface.points - self._centre) * self._unit
        cube = self._surface.cube
        points = points - places.rotation[cube, :, 2] * places.half_side[cube, None]
        self._carpet = Carpet(to, points, places.rotation[cube], self._surface.spacing * self._unit)
        self._carpet.node.on_click(self._pick)
        thick = {
            "shaft_radius": 0.025 * self._arrow,
            "head_radius": 0.075 * self._arrow,
            "head_length": 0.2 * self._arrow,
        }
        none = np.zeros((0, 2, 3))
        self._traction = to.add_arrows("/traction", none, WHITE, **thick)
        self._gradient = to.add_arrows("/gradient", none, GOLD, **thick)
        self._crosses = to.add_line_segments("/principal", none, WHITE, thickness=0.04 * self._pitch, visible=False)
        self._faults = to.add_line_segments("/faults", none, WHITE, thickness=0.06 * self._pitch)
        ring = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=1) * 0.62 * self._pitch
        self._ring = to.add_line_segments("/selected", np.stack([circle[:-1], circle[1:]], 1), WHITE,
                                        thickness=0.03 * self._pitch)  # fmt: skip
        self._contact = to.add_label("/contact", "", visible=False, anchor="bottom-center", font_screen_scale=1.3)

    def _make_controls(self, gui: viser.GuiApi, buttons: Buttons) -> None:
        self._head = gui.add_html("")
        self._paused = self._held = False
        row = gui.add_button_group("", ("pause", "tare", "clear tare", "record"))

        @row.on_click
        def _(_: object) -> None:
            if row.value == "pause":
                self._paused = not self._paused
            else:
                {"tare": buttons.tare, "clear tare": buttons.clear_tare, "record": buttons.record}[row.value]()

        self._action = gui.add_html("")
        with gui.add_folder("replay", visible=False) as self._replay:
            self._place = gui.add_slider("s", 0.0, 1.0, STEP_S, 0.0)
            self._hold = gui.add_button("hold")
        self._hold.on_click(lambda _: buttons.hold())
        # What `steer` shows has no client.
        self._place.on_update(lambda event: buttons.jump(self._place.value) if event.client else None)
        self._quantity = gui.add_dropdown("colour", [q.label for q in QUANTITIES.values()])
        self._quantity.on_update(lambda _: setattr(self, "_top", 0.0))
        self._range = gui.add_number("range (0: auto)", 0.0, min=0.0, step=0.1)
        self._legend = gui.add_html("")
        layers = gui.add_button_group("show", ("field", "traction", "gradient", "principal"))

        @layers.on_click
        def _(_: object) -> None:
            nodes = {"field": self._carpet.node, "traction": self._traction, "gradient": self._gradient}
            node = {**nodes, "principal": self._crosses}[layers.value]
            node.visible = not node.visible

        self._chosen = gui.add_dropdown("cube", self._names, initial_value=self._names[self.selected])

        @self._chosen.on_update
        def _(_: object) -> None:
            self.selected = self._names.index(self._chosen.value)

        with gui.add_folder("numbers"):
            self._numbers = gui.add_html("")
        with gui.add_folder("last 10 s"):
            empty = np.array([0.0])
            self._plots = []
            self._spans, self._written = [(0.0, 1.0) for _ in PLOTS], 0
            scales = {"x": TIME, "y": uplot.Scale(auto=False, range=(0.0, 1.0))}
            for title, _factor, columns in PLOTS:
                lines = [uplot.Series(label=markup.label(name), stroke=stroke, width=1.5, dash=dash)
                         for name, stroke, dash in zip(columns, STROKES, DASHES, strict=False)]  # fmt: skip
                axes = tuple(uplot.Axis(stroke="#ced4da", grid={"stroke": "#495057", "width": 0.5}, size=size)
                             for size in (34, 46))  # fmt: skip
                self._plots.append(gui.add_uplot(
                    (empty,) * (1 + len(lines)), (uplot.Series(label="s"), *lines), title=title, height=160, axes=axes,
                    scales=scales, padding=(4, 8, 0, 0)))  # fmt: skip
        with gui.add_folder("health"):
            self._health = gui.add_html("")

    def _pick(self, event: viser.SceneNodePointerEvent) -> None:
        start, ray = np.array(event.ray_origin), np.array(event.ray_direction)
        apart = np.linalg.norm(np.cross(self._places.position - start, ray / np.linalg.norm(ray)), axis=1)
        self._chosen.value = self._names[int(apart.argmin())]  # type: ignore[misc]  # Viser's own handle has the setter.

    @property
    def quantity(self) -> scene.Quantity:
        return next(q for q in QUANTITIES.values() if q.label == self._quantity.value)

    def draw(self, newest: Newest, health: np.ndarray) -> None:
        """Colours, arrows, crosses, carpet."""
        places, quantity = self._places, self.quantity
        values = newest.believed(health)
        shown = quantity.of(values, newest.residual)
        self._top = self._range.value * quantity.size or scene.automatic(quantity, shown, self._top)
        shear, gradient = QUANTITIES["shear"], QUANTITIES["gradient"]
        self._longest = scene.automatic(shear, values[:, 2:5], self._longest)
        self._steepest = scene.automatic(gradient, gradient.of(values, newest.residual), self._steepest)
        with self._server.atomic():
            self._cubes.batched_colors = light(scene.colours(quantity, shown, self._top))
            if self._carpet.node.visible:
                carpet = scene.colours(quantity, self._field(values, shown), self._top)
                self._carpet.paint(DIM * carpet)
            if self._traction.visible:
                arrows = scene.traction_arrows(places, values, 1.8 * self._arrow / self._longest)
                self._traction.points = _seen(arrows, 0.15 * self._arrow)
            if self._gradient.visible:
                arrows = scene.gradient_arrows(places, values, 1.2 * self._arrow / self._steepest)
                self._gradient.points = _seen(arrows, 0.15 * self._arrow)
            if self._crosses.visible:
                lines, pulls = scene.principal_crosses(places, values, self._pitch / self._longest)
                self._crosses.points = lines.reshape(-1, 2, 3).astype(np.float32)
                colours = np.where(pulls.reshape(-1, 1, 1), PULL, PUSH).repeat(2, axis=1)
                self._crosses.colors = colours.astype(np.uint8)
            bad = np.flatnonzero(health)
            crossed = Places(*(column[bad] for column in places))
            self._faults.points = scene.fault_crosses(crossed, health[bad]).reshape(-1, 2, 3).astype(np.float32)
            self._faults.colors = light(scene.MARK[health[bad]]).repeat(2, axis=0)[:, None].repeat(2, axis=1)
            up = places.rotation[self.selected, :, 2] * places.half_side[self.selected] * 1.1
            self._ring.position = places.position[self.selected] + up
            self._ring.wxyz = self._turns[self.selected]

    def _field(self, values: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """On the carpet: the interpolated field where it is pressure or shear, elsewhere each cube's own value."""
        if self.quantity is QUANTITIES["pressure"]:
            return self._surface.field(values).pressure
        if self.quantity is QUANTITIES["shear"]:
            return np.linalg.norm(np.nan_to_num(self._surface.field(values).shear), axis=1)
        return shown[self._surface.cube]

    def write(self, newest: Newest, health: np.ndarray, rate: np.ndarray, history: History, facts: Facts) -> None:
        """Status, legend, contact, the selected cube's numbers and plots, health."""
        k = self.selected
        if not self._paused:
            self._load = next(iter(self._surface.contacts(newest.believed(health), LEAST_PA)), None)
        hertz = float(np.nanmax(rate, initial=0.0))
        self._head.content = markup.head(health, hertz, self._load, self._paused or self._held, facts.recording)
        self._action.content = markup.box(escape(facts.action)) if facts.action else ""
        if self._paused:
            return
        self._legend.content = markup.legend(self.quantity, self._top)
        self._show_contact(self._load)
        self._numbers.content = markup.numbers(newest, k, health[k], rate[k])
        times, lines = history.of(k)
        self._written += 1
        for number, (plot, (_, factor, columns)) in enumerate(zip(self._plots, PLOTS, strict=True)):
            shown = [lines[:, History.COLUMNS.index(name)] * factor for name in columns]
            plot.data = (times, *shown)
            finite = np.concatenate(shown)
            finite = finite[np.isfinite(finite)]
            low, high = _nice(finite.min(initial=0.0), finite.max(initial=0.0))
            # A chart that the page makes before it knows its width has no time axis until its scales change.
            span = low, high + 1e-9 * (high - low) * (self._written // RENEW % 2)
            # uPlot cannot scale by itself where there is NaN.
            if self._spans[number] != span:
                self._spans[number], plot.scales = span, {"x": TIME, "y": uplot.Scale(auto=False, range=span)}
        self._health.content = markup.conditions(self._names, health, facts.links)

    def _show_contact(self, contact: Contact | None) -> None:
        if contact is None:
            self._contact.visible = False
            return
        place = (contact.position - self._centre) * self._unit + 1.1 * self._arrow * contact.normal
        self._contact.text = markup.newtons(contact)
        self._contact.position = place
        self._contact.visible = True


def _nice(low: float, high: float) -> tuple[float, float]:
    """A range of an axis that holds low .. high and zero, in steps so coarse that it seldom changes."""
    size = max(-low, high, 1e-9)
    power = 10.0 ** np.floor(np.log10(size))
    step = power * next(k for k in (1, 2, 5, 10) if k * power >= size * (1 - 1e-9)) / 2
    return float(np.floor(min(low, 0) / step) * step), float(np.ceil(max(high, 0) / step) * step)


def _seen(arrows: np.ndarray, least: float) -> np.ndarray:
    """The arrows that are longer than `least`: of shorter ones only the heads would be seen."""
    return arrows[np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=1) > least].astype(np.float32)
