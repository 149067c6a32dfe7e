"""
Tasks of the guide to the studio, done in Chromium by clicks, keys and files, and their pictures.

    python docs/studio_pictures.py        writes docs/pictures/studio_*.png
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

PICTURES = Path(__file__).parent / "pictures"
WIDTH, HEIGHT, TIMEOUT_MS = 1440, 900, 120_000
SOFTWARE = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
LOADED = "document.querySelector('#start img') && [...document.querySelectorAll('#start img')].every((one) => one.complete)"
SKIP_START = "localStorage.setItem('foveasim-studio-start', 'never')"
READY = "studio.isIdle"


def wait_for_views(page: Page) -> None:
    """Wait until the views show the current settings."""
    page.wait_for_selector("#views.loaded", timeout=TIMEOUT_MS)
    page.wait_for_function(READY, timeout=TIMEOUT_MS)


def put(page: Page, key: str, value: str) -> None:
    """Enter a value in a control."""
    field = page.locator(f".control[data-key='{key}'] input[type=text]").last
    field.fill(value)
    field.press("Enter")
    wait_for_views(page)


def choose(page: Page, key: str, label: str) -> None:
    """Select an alternative of a control."""
    page.locator(f".control[data-key='{key}'] select").first.select_option(label=label)
    wait_for_views(page)


def show(page: Page, *names: str) -> None:
    """Show exactly these tiles."""
    for button in page.locator("#tabs button").all():
        if (button.get_attribute("data-tile") in names) != (
            button.get_attribute("aria-pressed") == "true"
        ):
            button.click()
    wait_for_views(page)


def at(page: Page, fraction_x: float, fraction_y: float) -> tuple[float, float]:
    """Return a pixel of the map, as fractions of its width and height."""
    box = page.locator("#map").bounding_box()
    assert box is not None
    return box["x"] + fraction_x * box["width"], box["y"] + fraction_y * box["height"]


def download(page: Page, what: str, path: Path) -> Path:
    """Store a file of the menu."""
    page.click("#file")
    with page.expect_download() as found:
        page.click(f"#file-menu [data-file={what}]")
    found.value.save_as(path)
    return path


def start(page: Page) -> None:
    """Open the start page, when its thumbnails are loaded."""
    page.click("#start-open")
    page.wait_for_function(LOADED, timeout=TIMEOUT_MS)
    page.uncheck("#start-never")


def photograph(page: Page, picture: Path) -> None:
    """Open a photograph, move the gaze, and set exposure and f-number."""
    show(page, "histogram", "noise", "summary")
    page.set_input_files("#chosen-file", picture)
    wait_for_views(page)
    put(page, "exposure_s", "0.02")
    put(page, "optics.f_number", "4")
    page.locator("#scene canvas").last.focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        page.keyboard.press(key)
    wait_for_views(page)


def foveal_against_square(page: Page) -> None:
    """Keep the foveal sensor as A, and compare squares of the same number as B."""
    page.click("#freeze")
    show(page, "comparison", "mtf", "noise")
    choose(page, "layout", "grid")
    put(page, "layout.parameters.n_x", "170")
    put(page, "layout.parameters.n_y", "170")
    page.select_option("#match-what", "both")
    page.click("#match")
    wait_for_views(page)


def chip(page: Page, directory: Path) -> Path:
    """Combine layouts, draw and repair photosites, and write a GDSII file."""
    choose(page, "layout", "grid")
    put(page, "layout.parameters.n_x", "40")
    put(page, "layout.parameters.n_y", "40")
    put(page, "layout.parameters.pitch_um", "10")
    put(page, "layout.rules.min_size_um", "2.5")
    show(page, "rules", "steps")
    page.click("#fit")
    page.click("#edit")
    page.click("[data-tool=layer]")
    page.locator(".tool-options").get_by_label("Generator").select_option(
        label="log polar"
    )
    page.get_by_label("Margin in µm").fill("0.5")
    page.mouse.click(*at(page, 0.5, 0.5))
    wait_for_views(page)
    for name, value in (("r max", "90"), ("n sectors", "64"), ("min size", "1.5")):
        field = page.locator("#steps").get_by_label(name).first
        field.fill(value)
        field.press("Enter")
        wait_for_views(page)
    page.click("[data-tool=polygon]")
    for x, y in ((0.25, 0.25), (0.36, 0.22), (0.36, 0.36), (0.26, 0.38)):
        page.mouse.move(*at(page, x, y), steps=3)
        page.mouse.click(*at(page, x, y))
    page.keyboard.press("Enter")
    wait_for_views(page)
    page.click("[data-tool=repair]")
    page.click(".repairs li[data-method=best]:not(.pending) button")
    wait_for_views(page)
    return download(page, "gds", directory / "sensor.gds")


def lecture(page: Page, directory: Path) -> Path:
    """Show the effect of the f-number in all views, and write an archive for the audience."""
    show(page, "solid", "mtf", "photon_transfer", "snr")
    page.click("#freeze")
    put(page, "optics.f_number", "11")
    page.mouse.move(*at(page, 0.5, 0.5))
    page.wait_for_function(READY, timeout=TIMEOUT_MS)
    return download(page, "zip", directory / "lecture.zip")


def main() -> None:
    """Write all pictures."""
    command = [sys.executable, "-m", "foveasim", "studio", "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as playwright,
        tempfile.TemporaryDirectory() as directory,
    ):
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            address = next(
                word.rstrip(";,") for word in line.split() if word.startswith("http")
            )
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium-headless-shell")
                or shutil.which("chromium"),
                args=list(SOFTWARE),
            )
            temporary = Path(directory)
            tasks = {
                "light": ("light", wait_for_views),
                "start": ("light", start),
                "photograph": (
                    "light",
                    lambda page: photograph(
                        page, Path(str(files("skimage.data") / "coffee.png"))
                    ),
                ),
                "square": ("dark", foveal_against_square),
                "chip": ("light", lambda page: chip(page, temporary)),
                "lecture": ("dark", lambda page: lecture(page, temporary)),
            }
            for name, (scheme, task) in tasks.items():
                if len(sys.argv) > 1 and name not in sys.argv[1:]:
                    continue
                context = browser.new_context(
                    viewport={"width": WIDTH, "height": HEIGHT},
                    color_scheme=scheme,
                    bypass_csp=True,
                    accept_downloads=True,
                )
                context.add_init_script(SKIP_START)
                page = context.new_page()
                page.goto(address)
                wait_for_views(page)
                task(page)
                screenshot = Image.open(io.BytesIO(page.screenshot()))
                # 256 colours: a third of the size.
                screenshot.convert("RGB").quantize(256).save(
                    PICTURES / f"studio_{name}.png", optimize=True
                )
                context.close()
            browser.close()
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
