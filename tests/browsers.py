"""Chromium for the tests of pages."""

from __future__ import annotations

import shutil

from waiting import wait_until

#: Without the interface of the browser, where it is installed: a page takes half the processor time.
CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium")
#: WebGL by the processor, which every machine has; not for composing the page, which would take longer.
ARGUMENTS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing",
)  # fmt: skip
#: What the driver of Chromium writes to the console when a page reads the pixels of a canvas.
DRIVER_MESSAGE = "GL Driver Message"


def open_chromium(browser_type, *more):
    """Start the browser, with further arguments."""
    return browser_type.launch(executable_path=CHROMIUM, args=[*ARGUMENTS, *more])


def watch(page, problems, is_console_checked=True):
    """Append the errors of a page, and what it writes to the console, to a list."""
    page.on("pageerror", lambda error: problems.append(str(error.stack or error)))
    if is_console_checked:
        page.on("console", lambda message: DRIVER_MESSAGE in message.text or problems.append(message.text))


def wait_for_promise(frame, expression):
    """
    Wait until a promise of a page is fulfilled.

    The page keeps the outcome, and Python asks for it: a promise that only an evaluation awaits may be collected as garbage,
    upon which the evaluation fails (Playwright, "Resulting promise was garbage collected").
    """
    frame.evaluate(
        f"""() => {{
          window.outcome = null;
          Promise.resolve({expression}).then(() => {{ outcome = ""; }}, (error) => {{ outcome = String(error); }});
        }}"""
    )
    wait_until(lambda: frame.evaluate("outcome !== null"), step_s=0.02)
    assert frame.evaluate("outcome") == ""
