"""
Pictures of the studio in its guide: starts the studio, changes settings in Chromium, and writes screenshots.

    python docs/studio_pictures.py        writes docs/pictures/studio_light.png and studio_dark.png
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

PICTURES = Path(__file__).parent / "pictures"
WIDTH, HEIGHT, TIMEOUT_MS = 1440, 900, 120_000
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def wait_for_views(page: Page) -> None:
    """Wait until the views show the current settings."""
    page.wait_for_selector("#views.loaded", timeout=TIMEOUT_MS)
    page.wait_for_selector("body:not(.busy) #noise li", timeout=TIMEOUT_MS)
    page.wait_for_timeout(2500)


def put(page: Page, key: str, value: str) -> None:
    """Enter a value in a control."""
    field = page.locator(f".control[data-key='{key}'] input[type=text]").last
    field.fill(value)
    field.press("Enter")
    wait_for_views(page)


def main() -> None:
    """Write both pictures."""
    command = [sys.executable, "-m", "foveasim", "studio", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, sync_playwright() as playwright:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            address = next(word.rstrip(";,") for word in line.split() if word.startswith("http"))
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(SOFTWARE))
            for scheme in ("light", "dark"):
                context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme=scheme)
                page = context.new_page()
                page.goto(address)
                wait_for_views(page)
                if scheme == "dark":
                    page.click("#freeze")
                    put(page, "layout.parameters.n_sectors", "96")
                page.screenshot(path=PICTURES / f"studio_{scheme}.png")
                context.close()
            browser.close()
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
