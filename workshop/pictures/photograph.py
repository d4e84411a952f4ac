# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A picture of the running page in headless Chromium, while a load presses the chosen cube."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.wait import WebDriverWait

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-background-networking",
    "--enable-unsafe-swiftshader",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--window-size=1440,990",
)
"""Options of Chromium. It draws on the processor, because most test machines have no graphics
card."""

READY = """const text = document.body.innerText
return /of \\d+ cubes/.test(text) && text.includes('live')"""
"""JavaScript: whether the page shows a skin that is live."""

CLOSE_NOTES = (
    "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
)
"""JavaScript: close all notes, which would cover the skin."""

PRESSURE = """const found = /σzz\\s+([-+][0-9.]+)\\s+kPa/.exec(document.body.innerText)
return found ? -Number(found[1]) : 0"""
"""JavaScript: the pressure on the chosen cube, in kPa."""

MIN_PRESSURE_KPA = 6.0
"""Minimum pressure on the chosen cube, in kPa, at which the load counts as in contact."""

MAX_CHANGE_KPA = 0.3
"""Maximum change of the pressure, in kPa, within `STEADY_S` of a load that rests.

The picture is taken while the load rests, because a browser that draws on the processor shows the
3-D view some pictures later than the numbers.
"""

STEADY_S = 3.0
"""Time between the two pressures that are compared, in seconds; the load rests for 8 s."""

MAX_WAIT_S = 60.0
"""Time that each step may take, in seconds."""

POLL_S = 0.02
"""Period at which the page is looked at while a step is waited for, in seconds."""

TOUCHES = 2
"""Number of times that the load presses before the picture is taken.

When it presses for the second time, the plots of 10 s are full.
"""


@contextmanager
def open_chromium(url: str) -> Iterator[webdriver.Chrome]:
    """Open the page in a headless browser."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    for flag in FLAGS:
        options.add_argument(flag)
    browser = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    try:
        browser.set_script_timeout(MAX_WAIT_S)
        browser.get(url)
        yield browser
    finally:
        browser.quit()


def photograph(url: str, path: Path) -> None:
    """Write a picture of the page at a URL to a PNG file."""
    with open_chromium(url) as browser:
        wait = WebDriverWait(browser, MAX_WAIT_S, poll_frequency=POLL_S)
        wait.until(lambda _: browser.execute_script(READY))
        browser.execute_script(CLOSE_NOTES)
        for _ in range(TOUCHES - 1):
            wait.until(lambda _: browser.execute_script(PRESSURE) > MIN_PRESSURE_KPA)
            wait.until(lambda _: browser.execute_script(PRESSURE) < MIN_PRESSURE_KPA / 2)
        wait.until(lambda _: is_pressed_steadily(browser))
        browser.execute_script(CLOSE_NOTES)
        browser.save_screenshot(str(path))


def is_pressed_steadily(browser: webdriver.Chrome) -> bool:
    """Return whether a load presses the chosen cube and does not change."""
    before = browser.execute_script(PRESSURE)
    time.sleep(STEADY_S)
    change = abs(browser.execute_script(PRESSURE) - before)
    return bool(before > MIN_PRESSURE_KPA and change < MAX_CHANGE_KPA)
