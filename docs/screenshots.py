"""Take the picture of the live page in docs/service.md, with: python docs/screenshots.py.

Runs a case on real data, and takes a screenshot of its live page in headless Chromium.
Requires $LIVEPDE_DATA, and Chromium with its driver (Debian: chromium chromium-driver).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait

from livepde.dashboard import serve
from livepde.runs import JOURNAL
from livepde.runs.web import Address

PROJECT = Path(__file__).resolve().parents[1]
IMAGES = PROJECT / "docs" / "images"
PATIENCE = 180.0  # seconds
PAINTED = 2.0  # seconds until the browser has painted the plots
LIVE = 400  # samples after which the page of the live run is photographed


def command(case: str, folder: Path, *options: str) -> list[str]:
    """Return the command line that runs a case."""
    words = ["run", str(PROJECT / "cases" / case), "--out", str(folder), *options]
    return [sys.executable, "-m", "livepde", *words]


def browser() -> webdriver.Chrome:
    """Start Chromium."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
    ):
        options.add_argument(argument)
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def facts(page: webdriver.Chrome) -> int:
    """Return the number of samples that the page reports."""
    words = str(page.execute_script("return document.getElementById('facts').innerText")).split()
    return int(words[0]) if words else 0


def take(
    page: webdriver.Chrome,
    folder: Path,
    name: str,
    size: tuple[int, int],
    ready: Callable[[webdriver.Chrome], Any],
) -> None:
    """Save a screenshot of a run's page as a PNG file.

    Parameters
    ----------
    size
        Width and height in pixels.
    ready
        Condition on the page to wait for before the screenshot.
    """
    server = serve(folder, Address())
    screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    page.get(server.url)
    patient = WebDriverWait(page, PATIENCE)
    patient.until(lambda p: p.find_elements("css selector", ".panel .main-svg"))
    patient.until(ready)
    time.sleep(PAINTED)
    page.save_screenshot(str(IMAGES / f"{name}.png"))
    server.close()


def main() -> None:
    """Save the screenshot of a live run."""
    page = browser()
    with tempfile.TemporaryDirectory() as scratch:
        soil = Path(scratch) / "soil"
        live = subprocess.Popen(
            command("soil_layers.toml", soil, "--realtime", "--speed", "36000"),
            stdout=subprocess.DEVNULL,
        )
        while not (soil / JOURNAL).exists():
            if live.poll() is not None:
                raise SystemExit("the run has ended early")
            time.sleep(0.5)
        take(page, soil, "live-page", (1280, 1500), lambda p: facts(p) >= LIVE)
        live.terminate()
        live.wait()
    page.quit()


if __name__ == "__main__":
    main()
