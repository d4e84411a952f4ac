# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What one scan puts on the page, read from the messages of a websocket as a browser reads it."""

from __future__ import annotations

import re
import struct
import threading
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
pytest.importorskip("viser", reason="needs viser: run this with ./cube test")

import msgspec
import rclpy
import viser
import zstandard
from sensor_msgs.msg import PointCloud2
from websockets.sync.client import connect

from conftest import encoded
from cube_tensor_driver.browser import page as page_module
from cube_tensor_driver.browser.page import LEFT_WIDTH, RIGHT_WIDTH, Page, PageLayout
from cube_tensor_driver.browser.update import ShownSkin
from cube_tensor_driver.browser.viewer import MAX_STEP_S, Viewer
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, read_skin
from cube_tensor_driver.core.defaults import SURFACE_DEPTH
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.messages.contacts import encode_contacts, make_traction_message
from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress
from cube_tensor_driver.ros.compat import make_executor
from cube_tensor_driver.ros.messages import make_info_message, make_message
from cube_tensor_driver.ros.qos import LATCHED
from cube_tensor_driver.ros.session import spin_until
from cube_tensor_driver.touch.surface import Contact
from cube_tensor_driver.views import scene
from workshop.bench.views import CAMERA

SKIN = read_skin(find_package_data() / "config" / "skin_demo.yaml")
N = len(SKIN.cubes)
CHOSEN = 5
# Of scan k: the chosen cube is under k steps of pressure, and the strongest contact has k steps of
# force. So every number on the page tells its scan.
START_NS = 1_700_000_000_000_000_000
RATE = 100.0
STEP_PA = 100.0
STEP_N = 0.01
TOP_PA = 50e3
HERE = "127.0.0.1"


class PageReader(threading.Thread):
    """A browser that draws nothing: it keeps the state of the page after each update."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._socket = connect(
            f"ws://{HERE}:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        )
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self._objects: dict[str, dict] = {}
        self.states: list[SimpleNamespace] = []
        self.windows: list[int] = []
        self.labels: dict[str, str] = {}
        self.start()

    def run(self) -> None:
        for data in self._socket:
            self._apply(data)

    def close(self) -> None:
        self._socket.close()
        self.join()

    def click(self, label: str, value: object) -> None:
        """Set the value of the control with this label, as a browser does."""
        (uuid,) = (key for key, text in self.labels.items() if text == label)
        update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
        self._socket.send(msgspec.msgpack.encode(update))

    def _apply(self, data: bytes) -> None:
        _, size = struct.unpack_from("<QQ", data)
        content = zstandard.ZstdDecompressor().decompress(
            data[16 : 16 + size], max_output_size=1 << 26
        )
        decoded = msgspec.msgpack.decode(content)
        offset = 16 + size
        arrays = []
        for length in decoded.get("binaryBufferLengths") or []:
            offset += -offset % 8
            arrays.append(data[offset : offset + length])
            offset += length
        changed = False
        for message in decoded["messages"]:
            name = message.get("uuid") or message.get("name")
            values = message.get("updates") or message.get("props") or {}
            if not isinstance(values, dict) or name is None:
                continue
            if values.get("label"):
                self.labels[name] = values["label"]
            resolved = {key: resolve(value, arrays) for key, value in values.items()}
            self._objects.setdefault(name, {}).update(resolved)
            changed = changed or message["type"] == "GuiUpdateMessage"
        if changed:
            self._read_state()
        if self.states:  # The messages that build the page may fill a window.
            self.windows.append(len(decoded["messages"]))

    def _read_state(self) -> None:
        """Everything that depends on the scan, as numbers of the scan or in SI units."""
        texts = [str(one.get("content", "")) for one in self._objects.values()]
        (headline,) = [text for text in texts if "cubes" in text and "⬤" in text] or [""]
        (table,) = [text for text in texts if "residual</td>" in text] or [""]
        (contacts,) = [text for text in texts if " mm</td>" in text] or [""]
        force = re.search(r"([0-9.]+)&nbsp;N", headline)
        zz = re.search(r"σzz</td><td[^>]*>([-+0-9.]+)<", table)
        surface = re.search(r"on the surface</td><td[^>]*>(-?[0-9.]+) ± ", table)
        listed = re.search(r">([0-9.]+) N", contacts)
        legend = [text for text in texts if "linear-gradient" in text]
        top = re.findall(r"<span>([-0-9.]+)</span>", legend[0])[-1] if legend else "nan"
        plots = [one["data"] for one in self._objects.values() if one.get("data")]
        newest = [float(series[-1]) for series in plots[0][1:]] if plots else []
        colours = self._objects.get("/cubes", {}).get("batched_colors")
        if colours is None or not all((force, zz, listed, newest)):
            return
        self.states.append(
            SimpleNamespace(
                headline=headline,
                force=float(force[1]),
                zz=1e3 * float(zz[1]),
                listed=float(listed[1]),
                ring=self._objects["/contacts"]["points"],
                top=1e3 * float(top),
                plotted=1e3 * newest[-1],
                colour=colours.reshape(-1, 3)[CHOSEN].tolist(),
                rate=re.search(r"([0-9]+) Hz", headline)[1],
                surface=1e3 * float(surface[1]) if surface else np.nan,
                text="".join(texts),
            )
        )


def resolve(value: object, arrays: list[bytes]) -> object:
    """A property with the bytes of its arrays in place of their numbers."""
    if isinstance(value, dict) and "__binary_index" in value:
        return np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
    if isinstance(value, list):
        return [resolve(one, arrays) for one in value]
    return value


class Source:
    """Publishes scans, and later their contacts and traction, as the nodes of a skin do."""

    def __init__(self, ros) -> None:
        node = ros.node
        self._info = node.create_publisher(SkinInfo, "info", LATCHED)
        self._info.publish(make_info_message(SKIN, Pipeline(SKIN.calibrations), START_NS))
        self._stress = node.create_publisher(SkinStress, "stress", 100)
        self._contacts = node.create_publisher(SkinContacts, "contacts", 10)
        self._traction = node.create_publisher(PointCloud2, "traction", 10)
        self._points = SKIN.poses.position + np.array([0, 0, 0.004])
        self._pause = threading.Event()
        self.stamp_ns = {0: START_NS}

    def publish(self, numbers: range, hertz: float, contacts: bool = True) -> None:
        """The contacts come three scans later, and only those of every other scan."""
        for number in numbers:
            self.stamp_ns[number] = self.stamp_ns[number - 1] + round(1e9 / hertz)
            self._publish_scan(number)
            if contacts and number % 2 == 0 and number > 4:
                self._publish_results(number - 3)
            self._pause.wait(0.004)

    def _publish_scan(self, number: int) -> None:
        stress = np.zeros((N, 6), np.float32)
        stress[CHOSEN, 2], stress[0, 2] = -STEP_PA * number, -TOP_PA
        rows = StressRows.from_values(
            np.arange(N),
            stress,
            np.zeros((N, 9), np.float32),
            residual=1.0,
            stamp_ns=self.stamp_ns[number],
            sequence=number,
        )
        self._stress.publish(encoded(rows, b"skin_base\0"))

    def _publish_results(self, number: int) -> None:
        up, force = np.array([0, 0, 1.0]), STEP_N * number
        contact = Contact(0 * up, up, -force * up, force, 0.0, 1e-5, 1e-4, 0.1)
        of = self.stamp_ns[number], "skin_base"
        ones = np.ones(N)
        cloud = np.column_stack([self._points, STEP_PA * number * ones, 0 * ones, ones])
        # The page names the node as the source of the field only once both have come.
        self._contacts.publish(encode_contacts(*of, [contact]))
        self._traction.publish(make_traction_message(make_message, *of, cloud))


@pytest.fixture
def page(ros, tmp_path) -> Iterator[SimpleNamespace]:
    """The view in this process, a reader of its page, and a source of scans."""
    node, executor = rclpy.create_node("view"), make_executor()
    executor.add_node(node)
    view = Viewer(node, HERE, 0, tmp_path)
    stop = threading.Event()
    spin = partial(spin_until, executor, stop.is_set, step_s=MAX_STEP_S, on_step=view.step)
    spinning = threading.Thread(target=spin)
    spinning.start()
    reader = PageReader(int(view.url.rpartition(":")[2]))
    source = Source(ros)
    try:
        ros.wait(lambda: "colour" in reader.labels.values())
        yield SimpleNamespace(reader=reader, source=source)
    finally:
        reader.close()
        stop.set()
        spinning.join()
        view.close()
        executor.remove_node(node)
        node.destroy_node()


def test_all_that_a_browser_receives_at_once_is_of_one_scan(page, ros):
    """Picture, numbers, plots, contacts and field; and the rate is that of the stamps."""
    page.reader.click("top (0: auto)", TOP_PA / 1e3)
    page.source.publish(range(1, 400), RATE)
    ros.wait(lambda: page.reader.states and page.reader.states[-1].rate == "100")
    # Before the first contacts have come, the page finds some itself.
    states = [state for state in page.reader.states if "from the node contacts" in state.text]
    assert len({state.zz for state in states}) > 2
    for state in states:
        number = round(-state.zz / STEP_PA)
        assert state.zz == pytest.approx(-STEP_PA * number, abs=1)
        assert state.plotted == pytest.approx(state.zz, rel=1e-5)
        assert state.force == state.listed == pytest.approx(STEP_N * number, abs=0.005)
        # The text has hundredths of a kPa.
        assert np.ptp(state.ring) > 0
        assert state.surface == pytest.approx(-state.zz, abs=5.1)
        assert state.top == pytest.approx(TOP_PA)
        colour = scene.choose_colours(scene.QUANTITIES["pressure"], np.array([-state.zz]), TOP_PA)
        assert state.colour == scene.convert_to_linear_light(colour)[0].tolist()
    # viser applies at most 128 messages at once.
    assert max(page.reader.windows) < 128


def test_the_surface_is_where_the_skin_file_states_it():
    for elastomer, depth in ((None, SURFACE_DEPTH), (Elastomer(5e-3, 11e-3), 5e-3)):
        shown = ShownSkin("skin", SKIN.names, SKIN.poses, SKIN.calibrations, elastomer)
        assert shown.surface.depth == depth


def test_a_paused_page_stays_and_only_follows_the_choices_of_its_user(page, ros):
    reader, source = page.reader, page.source
    source.publish(range(1, 200), RATE)
    reader.click("view", "pause the page")
    ros.wait(lambda: "paused" in reader.states[-1].headline)
    before = reader.states[-1]
    source.publish(range(200, 400), RATE / 2)
    assert reader.states[-1].text == before.text and "100 Hz" in before.text

    reader.click("colour", scene.QUANTITIES["shear"].label)
    ros.wait(lambda: "shear |σzx, σyz| in kPa" in reader.states[-1].text)
    assert (reader.states[-1].headline, reader.states[-1].zz) == (before.headline, before.zz)

    reader.click("view", "go on")
    ros.wait(lambda: "live" in reader.states[-1].headline and reader.states[-1].zz < before.zz)


def test_automatic_ranges_fall_only_with_new_values(monkeypatch):
    """In a replay that is held, the page is shown again and again with the same values."""

    def build(skin, scan, history, settings, before):
        return {}, before.follow(scan.values, np.ones(N), 0.0)

    def ignore(*_: object) -> None:
        pass

    monkeypatch.setattr(page_module, "build_update", build)
    ranges = scene.Ranges()
    shown = SimpleNamespace(_scan=None, _frozen=None, _paused=False, _skin=None, _ranges=ranges)
    shown.send = shown._read_settings = shown._show_status = ignore
    tops = []
    for pressure in (TOP_PA, 0.0, 0.0, 0.0, 1.0):
        values = np.full((N, 15), np.nan)
        values[CHOSEN] = -pressure
        Page.show(shown, SimpleNamespace(values=values), None, None)
        tops.append(shown._ranges.traction / TOP_PA)
    decay = scene.RANGE_DECAY
    np.testing.assert_allclose(tops, [1, decay, decay, decay, decay**2])


@pytest.mark.parametrize(
    ("size", "folded"), [((1440, 900), False), ((1024, 768), True), ((390, 844), True)]
)
def test_the_skin_keeps_at_least_half_of_the_width(size, folded):
    layout = PageLayout(*size)
    assert layout.is_folded == folded
    if size[0] > size[1]:
        panels = RIGHT_WIDTH + (0 if folded else LEFT_WIDTH)
        assert size[0] - panels >= size[0] / 2
