"""Takes a picture of the running browser view in headless Chromium, while a load presses the chosen
cube.

Use: photograph.py URL FILE.png
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

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
READY = """const text = document.body.innerText
return /of \\d+ cubes/.test(text) && text.includes('live')"""
CLEAR = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
PRESSURE = """const found = /σzz\\s+([-+][0-9.]+)\\s+kPa/.exec(document.body.innerText)
return found ? -Number(found[1]) : 0"""
"""Of the chosen cube, kPa."""
LEAST_KPA, STEADY_KPA, STEADY_S, WAIT_S = 6.0, 0.3, 0.6, 60.0
TOUCHES = 2
"""The load comes and goes. The picture shows it when it presses the second time: then the plots are
full. It is taken while the load rests, so that all numbers are those of the picture."""


@contextmanager
def chromium(url: str, script: str = "") -> Iterator[webdriver.Chrome]:
    """A headless browser that shows the page. script: runs before the page's own code."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    for flag in FLAGS:
        options.add_argument(flag)
    browser = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    try:
        browser.set_script_timeout(60)
        browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})
        browser.get(url)
        yield browser
    finally:
        browser.quit()


def photograph(url: str, path: str) -> None:
    """Write the picture to the file `path`."""
    with chromium(url) as browser:
        wait = WebDriverWait(browser, WAIT_S, poll_frequency=0.02)
        wait.until(lambda _: browser.execute_script(READY))
        browser.execute_script(CLEAR)
        for _ in range(TOUCHES - 1):
            wait.until(lambda _: browser.execute_script(PRESSURE) > LEAST_KPA)
            wait.until(lambda _: browser.execute_script(PRESSURE) < LEAST_KPA / 2)
        wait.until(lambda _: is_steady(browser))
        browser.execute_script(CLEAR)
        browser.save_screenshot(path)


def is_steady(browser: webdriver.Chrome) -> bool:
    """Whether a load presses the chosen cube and does not change."""
    before = browser.execute_script(PRESSURE)
    time.sleep(STEADY_S)
    change = abs(browser.execute_script(PRESSURE) - before)
    return bool(before > LEAST_KPA and change < STEADY_KPA)


if __name__ == "__main__":
    photograph(*sys.argv[1:])
