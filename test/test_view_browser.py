"""The browser view in a real browser: a page, a load that comes, a cube that is chosen, a tare that is asked for."""

from __future__ import annotations

import io
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
pytest.importorskip("selenium", reason="needs selenium: run this with ./cube test")

from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from std_msgs.msg import Header

from conftest import ROOT
from cube_tensor_driver.core.pipeline import Pipeline, StressRows
from cube_tensor_driver.files.share import share
from cube_tensor_driver.files.skin import read_skin
from cube_tensor_driver.msg import SkinInfo, SkinStress
from cube_tensor_driver.ros.messages import Times, info_message, stress_message, to_time
from cube_tensor_driver.srv import Tare

CHROMIUM, DRIVER = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
FLAGS = ("--headless", "--no-sandbox", "--disable-background-networking", "--enable-unsafe-swiftshader",
         "--use-gl=angle", "--use-angle=swiftshader", "--window-size=1200,900")  # fmt: skip
SKIN = read_skin(share() / "config" / "skin_demo.yaml")
N = len(SKIN.cubes)
PRESSED = 10


@pytest.fixture
def page(domain) -> Iterator[tuple[object, str]]:
    """A browser that shows a view of its own process."""
    if not CHROMIUM or not DRIVER:
        pytest.skip("needs a browser: apt-get install chromium chromium-driver")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    view = subprocess.Popen(
        [sys.executable, "-m", "cube_tensor_driver.cli", "view", "--port", str(port)], cwd=ROOT,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in FLAGS:
        options.add_argument(flag)
    browser = None
    try:
        until = time.monotonic() + 30
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert view.poll() is None and time.monotonic() < until, "the view did not start"
        browser = webdriver.Chrome(options, Service(DRIVER))
        browser.set_script_timeout(60)
        browser.get(f"http://127.0.0.1:{port}")
        yield browser, f"127.0.0.1:{port}"
    finally:
        if browser is not None:
            browser.quit()
        view.terminate()
        view.communicate(timeout=15)
    assert view.returncode == 0


class Skin:
    """Publishes what a driver and a reconstruction would: latched info, and rows whenever it is turned."""

    def __init__(self, ros) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._info = ros.node.create_publisher(SkinInfo, "info", latched)
        self._info.publish(info_message(SKIN, Pipeline([cube.calibration for cube in SKIN.cubes]), time.time_ns()))
        self._stress = ros.node.create_publisher(SkinStress, "stress", 10)
        self.zz = 0.0

    def send(self) -> None:
        stress, gradient = np.zeros((N, 6), np.float32), np.zeros((N, 9), np.float32)
        stress[:, [1, 3, 5]] = np.nan
        stress[PRESSED, 2] = self.zz
        gradient[:, [1, 4, 7]] = np.nan
        rows = StressRows(stress, gradient, np.ones(N, np.float32), np.zeros(N, np.uint16), np.zeros(N, np.uint16))
        times = Times(Header(stamp=to_time(time.time_ns())), np.arange(N, dtype=np.uint16),
                      np.zeros(N, np.uint32), np.zeros(N, np.int32))  # fmt: skip
        self._stress.publish(stress_message(times, rows))


def test_the_page_shows_a_load_a_cube_and_a_tare(page, ros):
    browser, _ = page
    skin = Skin(ros)
    asked = []

    def tare(request, answer):
        asked.append(request)
        skin.zz = 0.0
        answer.success, answer.message = True, "16 cubes over 1 s"
        return answer

    ros.node.create_service(Tare, "reconstruction/tare", tare)

    def until(done: Callable[[], object], seconds: float = 40.0) -> None:
        """Rows keep coming meanwhile: a skin that is silent is stale."""

        def turned() -> object:
            skin.send()
            return done()

        ros.wait(turned, seconds)

    def text() -> str:
        return browser.execute_script("return document.body.innerText")

    def yellow() -> np.ndarray:
        """Pixels (y, x) of the 3-D part with the colour of the range's top."""
        image = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        red, green, blue = np.asarray(image)[:, : image.width // 2].astype(int).transpose(2, 0, 1)
        return np.argwhere((red > 150) & (green > 130) & (blue < 90))

    until(lambda: f"{N} of {N} cubes" in text() and "live" in text())
    assert "pressure −σzz in kPa" in text()
    until(lambda: "state" in text())
    assert len(yellow()) == 0

    skin.zz = -20e3
    seen: list[np.ndarray] = []
    until(lambda: seen.append(yellow()) or len(seen[-1]) > 200)
    # the legend's top follows: 20 kPa
    until(lambda: "\n20\n" in text())

    # another cube is shown until this one is clicked
    assert "-20.000" not in text()
    y, x = np.median(seen[-1], axis=0)
    canvas = browser.find_element("tag name", "body")
    ActionChains(browser).move_to_element_with_offset(
        canvas, int(x) - canvas.size["width"] // 2, int(y) - canvas.size["height"] // 2
    ).click().perform()
    until(lambda: "-20.000" in text())
    drawn = browser.execute_script("return document.querySelectorAll('.uplot canvas').length")
    assert drawn == 4

    press(browser, "tare")
    until(lambda: asked)
    assert list(asked[0].cubes) == []
    until(lambda: "tare done: 16 cubes over 1 s" in text() and "-20.000" not in text())

    press(browser, "clear tare")
    until(lambda: "no reconstruction node" in text())


def press(browser, label: str) -> None:
    script = "for (const b of document.querySelectorAll('button')) if (b.innerText.trim() == arguments[0]) b.click()"
    browser.execute_script(script, label)
