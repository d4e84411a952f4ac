"""Takes a picture of the browser view in headless Chromium, while a load presses.

Use: photograph.py URL FILE.png
"""

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
READY = """const text = document.body.innerText
return /of \\d+ cubes/.test(text) && text.includes('live')"""
HELD = """return new Promise(drawn => {
  if (!document.body.innerText.includes('paused')) return drawn(false)
  let left = 3
  const next = () => left-- ? requestAnimationFrame(next) : drawn(true)
  next() })"""
"""Whether the page is paused, after it has been drawn again."""
CLICK = """for (const button of document.querySelectorAll('button'))
  if (button.innerText.trim() == 'pause') button.click()"""
CLEAR = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
LOADED = "return Number((/([0-9.]+) N, shear/.exec(document.body.innerText) || [0, 0])[1])"
LEAST_N, WAIT_S = 2.2, 60.0
TOUCHES = 3
"""The load comes and goes. The picture shows it when it presses the third time: then the plots are
full."""


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
            wait.until(lambda _: browser.execute_script(LOADED) > LEAST_N)
            wait.until(lambda _: browser.execute_script(LOADED) < LEAST_N / 2)
        wait.until(lambda _: paused_under_load(browser, wait))
        browser.save_screenshot(path)


def paused_under_load(browser: webdriver.Chrome, wait: WebDriverWait[webdriver.Chrome]) -> bool:
    """Wait for the load, then pause the page.

    False: by then the load was gone. The page runs on in this case.
    """
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
