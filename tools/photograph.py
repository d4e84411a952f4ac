"""A picture of a page in headless Chromium, once the page has drawn what it shows: photograph.py
URL FILE.png"""

from __future__ import annotations

import shutil
import sys
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
    "--window-size=1400,950",
)
READY = "return /of \\d+ cubes/.test(document.body.innerText) && document.body.innerText.includes('live')"
HELD = """return new Promise(drawn => {
  if (!document.body.innerText.includes('paused')) return drawn(false)
  let left = 3
  const next = () => left-- ? requestAnimationFrame(next) : drawn(true)
  next() })"""
"""Paused, and drawn since."""
CLICK = "for (const b of document.querySelectorAll('button')) if (b.innerText.trim() == 'pause') b.click()"
CLEAR = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
LOADED = "return Number((/([0-9.]+) N, shear/.exec(document.body.innerText) || [0, 0])[1])"
LEAST_N, WAIT_S, COMINGS = 2.2, 60.0, 3
"""The load comes and goes: the picture is of its third coming, when the plots are full, while it
presses."""


@contextmanager
def chromium(url: str, script: str = "") -> Iterator[webdriver.Chrome]:
    """A headless browser that shows the page; script: runs before the page's own."""
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
    with chromium(url) as browser:
        wait = WebDriverWait(browser, WAIT_S, poll_frequency=0.02)
        wait.until(lambda _: browser.execute_script(READY))
        browser.execute_script(CLEAR)
        for _ in range(COMINGS - 1):
            wait.until(lambda _: browser.execute_script(LOADED) > LEAST_N)
            wait.until(lambda _: browser.execute_script(LOADED) < LEAST_N / 2)
        wait.until(lambda _: pressed(browser, wait))
        browser.save_screenshot(path)


def pressed(browser: webdriver.Chrome, wait: WebDriverWait[webdriver.Chrome]) -> bool:
    """Wait for the load and hold the page; whether it was still pressing by then. If not the page
    runs again."""
    wait.until(lambda _: browser.execute_script(LOADED) > LEAST_N)
    browser.execute_script(CLICK)
    wait.until(lambda _: browser.execute_script(HELD))
    if browser.execute_script(LOADED) > LEAST_N:
        return True
    browser.execute_script(CLICK)
    wait.until(lambda _: browser.execute_script(READY))
    return False


if __name__ == "__main__":
    photograph(*sys.argv[1:])
