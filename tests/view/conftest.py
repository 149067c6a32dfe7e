"""Browser of the tests of pages and widgets."""

from __future__ import annotations

import shutil

import pytest

#: WebGL by the processor, which every machine has.
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(SOFTWARE))
        yield chromium
        chromium.close()
