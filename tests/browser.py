"""Chromium in tests, and functions that read a page in it."""

import json
import shutil
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from patience import PATIENCE


@contextmanager
def chromium(width: int = 1280):
    """Start a browser; at the end, check that it logged no error and contacted only our server."""
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no Chromium: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--window-size={width},1400",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    page = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield page
        assert [line for line in page.get_log("browser") if line["level"] == "SEVERE"] == []
        here = urlsplit(page.current_url).netloc
        assert {urlsplit(url).netloc for url in requested(page)} <= {here, ""}
    finally:
        page.quit()


def requested(page) -> list[str]:
    """Return the addresses that a page has requested."""
    messages = [json.loads(line["message"])["message"] for line in page.get_log("performance")]
    urls = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert urls
    return [url for url in urls if urlsplit(url).scheme in ("http", "https", "ws", "wss")]


def wait(page, condition):
    """Wait until a condition on the page is true, and return its value."""
    from selenium.common.exceptions import StaleElementReferenceException as Stale
    from selenium.webdriver.support.ui import WebDriverWait

    return WebDriverWait(page, PATIENCE, 0.2, ignored_exceptions=[Stale]).until(condition)


def text(page, selector: str) -> str:
    return page.execute_script(
        "return [...document.querySelectorAll(arguments[0])].map(e => e.innerText).join('\\n')",
        selector,
    )


def count(page) -> int:
    words = text(page, "#facts").split()
    return int(words[0]) if words else 0
