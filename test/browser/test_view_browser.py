# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The page of ./cube view in a real browser: a load, a cube that is chosen, a tare, a replay that
is held and jumps."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from urllib.parse import urlparse

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
pytest.importorskip("selenium", reason="needs selenium: run this with ./cube test")

import viser
from bag_maker import START_NS, make_bag
from PIL import Image
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from websockets.sync.client import connect

from conftest import ROOT, encoded, end
from cube_tensor_driver.browser.page import LEFT_WIDTH
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.srv import SteerReplay

CHROMIUM, DRIVER = (
    shutil.which("chromium") or shutil.which("google-chrome"),
    shutil.which("chromedriver"),
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-background-networking",
    "--enable-unsafe-swiftshader",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--window-size=1440,560",
)
CONFIG = find_package_data() / "config" / "skin_demo.yaml"
SKIN = read_skin(CONFIG)
N = len(SKIN.cubes)
PRESSED, RATE, NOISE = 10, 50.0, 8e-6
HERE = "127.0.0.1"
LOOK_S = 0.15
STOP, GO_ON = "stop the replay", "go on with the replay"


@pytest.fixture(scope="module")
def page() -> Iterator[webdriver.Chrome]:
    """One browser for all tests."""
    if not CHROMIUM or not DRIVER:
        pytest.skip("needs a browser: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    for flag in FLAGS:
        options.add_argument(flag)
    chrome = webdriver.Chrome(options, Service(DRIVER))
    try:
        chrome.set_script_timeout(60)
        yield chrome
    finally:
        chrome.quit()


class Skin(threading.Thread):
    """Publishes the frequencies of a driver, under a load that the test sets, until ended."""

    def __init__(self, node) -> None:
        super().__init__()
        self._publisher = node.create_publisher(SkinFrequencies, "frequencies", 1000)
        self._ended = threading.Event()
        self.sent = 0
        self.press(0.0)

    def press(self, zz: float) -> None:
        """zz in Pa on the pressed cube."""
        state = np.zeros((N, 7))
        state[PRESSED, 0] = zz
        calibration = SKIN.cubes[0].calibration
        law = calibration.rest_frequency, calibration.beta, calibration.modulus
        self._frequency = compute_pad_frequency(state @ calibration.response.T, *law)

    def run(self) -> None:
        noise = np.random.default_rng(3)
        cubes, none = np.arange(N, dtype=np.uint16), np.zeros(N, np.uint32)
        while not self._ended.wait(1 / RATE):
            frequency = self._frequency * (1 + NOISE * noise.standard_normal(self._frequency.shape))
            sequence, now = np.full(N, self.sent, np.uint32), np.full(N, time.time_ns())
            scan = FrequencyRows(
                cubes,
                sequence,
                now,
                frequency.astype(np.float32),
                np.full(N, np.nan, np.float32),
                none,
                none.astype(np.uint16),
            )
            self._publisher.publish(encoded(scan, b"skin_base\0"))
            self.sent += 1

    def end(self) -> None:
        self._ended.set()
        self.join()


@pytest.mark.alone
def test_the_page_shows_a_load_a_cube_and_a_tare(ros, tmp_path, page):
    """Beside a browser that has stopped reading, and without the internet; before, that there is
    none."""
    # The queue holds the messages of the longest waits for the browser.
    heard = ros.listen(SkinStress, "stress", 10_000)
    skin = Skin(ros.node)
    with ExitStack() as stack:
        children = stack.enter_context(Children(tmp_path))
        children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
        url = children.wait_for_line("view", "http://", 30).split()[0]
        port = urlparse(url).port
        sleeper = socket.socket()
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sleeper.connect((HERE, port))
        stack.enter_context(
            connect(
                f"ws://{HERE}:{port}",
                sock=sleeper,
                max_queue=1,
                subprotocols=[f"viser-v{viser.__version__}"],
            )
        )
        page.get(url)
        waiting = (
            f"Waiting for a skin: none is published in DDS domain {os.environ['ROS_DOMAIN_ID']}."
        )
        children.wait_for_line("view", waiting, 10)
        see(ros, page, lambda text: waiting in text)
        assert not page.find_element("class name", "tabler-icon-cloud-check").is_displayed()
        children.start(
            Process(
                "reconstruction",
                "cube_tensor_driver.ros.nodes.reconstruction",
                parameters={
                    "config": str(CONFIG),
                    "tare_folder": str(tmp_path / "tare"),
                    "tare_duration": 0.5,
                },
            )
        )
        skin.start()
        stack.callback(skin.end)

        expected = (f"{N} of {N} cubes", "live", "pressure −σzz in kPa", "state")
        see(ros, page, lambda text: all(one in text for one in expected))
        assert "Waiting" not in text(page)
        # A few pixels are dark red where the red and the blue axis meet.
        assert len(dark_red(page)) < 10

        skin.press(-20e3)
        pressed_ns = time.time_ns()
        seen: list[np.ndarray] = []
        ros.wait(lambda: seen.append(dark_red(page)) or len(seen[-1]) > 100, 40)
        # The legend's top follows: 20 kPa at the cube, and more on the surface above it.
        see(ros, page, lambda text: legend_top(text) >= 20)

        # another cube is shown until this one is clicked
        assert shown(text(page)) > -100
        y, x = np.median(seen[-1], axis=0)
        body = page.find_element("tag name", "body")
        ActionChains(page).move_to_element_with_offset(
            body, int(x) - body.size["width"] // 2, int(y) - body.size["height"] // 2
        ).click().perform()
        see(ros, page, lambda text: abs(shown(text) + 20e3) < 200)
        assert page.execute_script("return document.querySelectorAll('.uplot canvas').length") == 2

        # another browser chooses for itself
        chosen = page.current_window_handle
        page.switch_to.new_window("tab")
        page.get(url)
        see(ros, page, lambda text: all(one in text for one in expected) and shown(text) > -100)
        page.close()
        page.switch_to.window(chosen)
        see(ros, page, lambda text: abs(shown(text) + 20e3) < 200)

        # What the page shows as tared is tared on the topic. The load must not have moved before:
        # a tare would be refused.
        ros.wait(
            lambda: (
                heard and rows(heard)[-1][0] > pressed_ns + 1e9 and abs(newest(heard) + 20e3) < 200
            )
        )
        clicked_ns = time.time_ns()
        press(page, "tare")

        def is_tared(text: str) -> bool:
            # A busy machine interrupts the skin, and a tare over the gap is refused.
            is_done = "tare done" in text
            if not is_done and "gaps in it" in text:
                press(page, "tare")
            return is_done

        see(ros, page, is_tared)
        see(ros, page, lambda text: abs(shown(text)) < 200)
        ros.wait(lambda: abs(newest(heard)) < 200)
        tared_ns = min(at for at, zz in rows(heard) if at > clicked_ns and abs(zz) < 200)
        milliseconds = 1e-6 * (tared_ns - clicked_ns)
        print(f"from the click on tare to the first tared row: {milliseconds:.0f} ms")
        press(page, "undo tare")
        see(ros, page, lambda text: abs(shown(text) + 20e3) < 200)
        ros.wait(lambda: abs(newest(heard) + 20e3) < 200)

        # no row of the topic is missing because of the browser that reads nothing
        sequence = np.array([message.sequence[0] for message in heard], int)
        assert len(sequence) > 100 and (np.diff(sequence) == 1).all()
        asked = hosts(page)
        assert asked == {HERE}, f"the page asks {asked}"
        children.check()


@pytest.mark.alone
def test_a_replay_is_controlled_from_the_page(ros, tmp_path, page):
    """A bag of 30 s whose cubes swing with a period of 2 s.

    It is so long that a slow browser sees it play before it holds at its end.
    """
    path = make_bag(tmp_path / "bag", CONFIG, 3000)
    heard = ros.listen(SkinStress, "stress")
    replay = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "cube_tensor_driver.cli",
            "replay",
            str(path),
            "--view",
            "--start",
            "29.5",
        ],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        url = next(line for line in replay.stderr if "http://" in line).split()[0]
        page.get(url)

        def position() -> float:
            """Of the newest row in the bag, s."""
            return 1e-9 * (to_ns(heard[-1].header.stamp) - START_NS)

        # It has come to the end, and holds there. Its cubes do not become stale.
        ros.wait(lambda: heard and position() > 29.9 and GO_ON in buttons(page), 40)
        see(ros, page, lambda text: "paused" in text and f"{N} of {N} cubes" in text)

        def key(one: str, wanted: float) -> None:
            ros.wait(lambda: taken(one, wanted))

        def taken(one: str, wanted: float) -> bool:
            # The page may draw the slider again at any time, also between these steps.
            try:
                slider = page.find_element("css selector", "[role=slider]")
                page.execute_script("arguments[0].focus()", slider)
                slider.send_keys(one)
                return float(slider.get_attribute("aria-valuenow")) == wanted
            except StaleElementReferenceException:
                return False

        key(Keys.HOME, 0.0)
        ros.wait(lambda: position() < 0.3, 40)
        assert GO_ON in buttons(page)
        count, at = len(heard), position()
        press(page, GO_ON)
        ros.wait(lambda: len(heard) > count + 20 and position() > at + 0.2, 40)
        ros.wait(lambda: STOP in buttons(page), 40)
        press(page, STOP)
        ros.wait(lambda: GO_ON in buttons(page), 40)
        key(Keys.HOME, 0.0)
        ros.wait(lambda: position() < 0.3, 40)
        key(Keys.END, 30.0)
        ros.wait(lambda: position() > 29.8, 40)
        ros.wait(lambda: slider_value(page) > 29.8, 40)
        assert f"{N} of {N} cubes" in text(page)
        refused = ros.call(
            SteerReplay, "player/steer", SteerReplay.Request(position=30.5, paused=True)
        )
        assert (
            not refused.success
            and "30.5 s is not in the bag, which is 29.990 s long" in refused.message
        )
        replay.terminate()
        assert replay.wait(timeout=10) == 0
        assert "Traceback" not in replay.stderr.read()
    finally:
        end(replay)


def see(ros, page: webdriver.Chrome, found: Callable[[str], object]) -> None:
    """Wait until this is true of the page's text. The text is not asked for all the time: a browser
    without a graphics card draws nothing meanwhile."""
    look_at = 0.0

    def seen() -> object:
        nonlocal look_at
        if time.monotonic() < look_at:
            return False
        look_at = time.monotonic() + LOOK_S
        return found(text(page))

    ros.wait(seen, 40)


def text(page: webdriver.Chrome) -> str:
    return page.execute_script("return document.body.innerText")


def slider_value(page: webdriver.Chrome) -> float:
    script = "return document.querySelector('[role=slider]').getAttribute('aria-valuenow')"
    return float(page.execute_script(script))


def buttons(page: webdriver.Chrome) -> list[str]:
    return page.execute_script(
        "return [...document.querySelectorAll('button')].map(b => b.innerText.trim())"
    )


def press(page: webdriver.Chrome, label: str) -> None:
    page.execute_script(
        "for (const button of document.querySelectorAll('button'))"
        "  if (button.innerText.trim() == arguments[0]) button.click()",
        label,
    )


def shown(text: str) -> float:
    """zz of the chosen cube as the page has it, Pa."""
    found = re.search(r"^σzz\s+([+-][0-9.]+)\s+kPa", text, re.MULTILINE)
    return 1e3 * float(found[1]) if found else np.nan


def legend_top(text: str) -> float:
    """Upper end of the colour scale, in kPa."""
    found = re.search(r"([0-9.]+)\s+pressure −σzz in kPa", text)
    return float(found[1]) if found else np.nan


def rows(heard: list) -> list[tuple[int, float]]:
    """When each message was measured, ns, and zz of its pressed cube, Pa."""
    return [
        (to_ns(message.header.stamp), float(message.stress[6 * PRESSED + 2])) for message in heard
    ]


def newest(heard: list) -> float:
    return rows(heard[-1:])[0][1]


def dark_red(page: webdriver.Chrome) -> np.ndarray:
    """Pixels (y, x) of the 3-D part, between the panels, with the colour of the range's top."""
    image = Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")
    between = slice(int(LEFT_WIDTH) + 20, image.width - 340)
    red, green, blue = np.asarray(image)[:, between].astype(int).transpose(2, 0, 1)
    found = np.argwhere((red > 90) & (red < 190) & (green < 50) & (blue < 70))
    return found + np.array([0, between.start])


def hosts(page: webdriver.Chrome) -> set[str | None]:
    """The hosts that the page has asked for anything, or tried to."""
    events = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    urls = [
        event["params"].get("request", event["params"])["url"]
        for event in events
        if event["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated")
    ]
    return {
        urlparse(url).hostname
        for url in urls
        if urlparse(url).scheme not in ("data", "blob", "chrome")
    }
