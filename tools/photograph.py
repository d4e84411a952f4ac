"""A picture of a page in headless Chromium, once the page has drawn what it shows: photograph.py URL FILE.png"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

FLAGS = ("--headless", "--no-sandbox", "--disable-background-networking", "--enable-unsafe-swiftshader",
         "--use-gl=angle", "--use-angle=swiftshader", "--window-size=1400,950")  # fmt: skip
LOOK_S, SETTLE_S = 12.0, 2.0
"""The plots show 10 s; a machine without a graphics card takes a while to draw."""
CLICK = "for (const b of document.querySelectorAll('button')) if (b.innerText.trim() == 'pause') b.click()"
CLEAR = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
LOADED = "return Number((/([0-9.]+) N, shear/.exec(document.body.innerText) || [0, 0])[1])"
LEAST_N, WAIT_S = 2.2, 20.0
"""The load comes and goes: the picture waits until it presses."""


@contextmanager
def chromium(url: str) -> Iterator[webdriver.Chrome]:
    """A headless browser that shows the page."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    for flag in FLAGS:
        options.add_argument(flag)
    browser = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    try:
        browser.set_script_timeout(60)
        browser.get(url)
        yield browser
    finally:
        browser.quit()


def photograph(url: str, path: str) -> None:
    with chromium(url) as browser:
        time.sleep(LOOK_S)
        browser.execute_script(CLEAR)
        until = time.monotonic() + WAIT_S
        while browser.execute_script(LOADED) < LEAST_N and time.monotonic() < until:
            time.sleep(0.02)
        browser.execute_script(CLICK)
        time.sleep(SETTLE_S)
        browser.save_screenshot(path)


if __name__ == "__main__":
    photograph(*sys.argv[1:])
