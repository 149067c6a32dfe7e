"""The studio in a browser, for tests: a server in a thread, and steps on its page."""

from __future__ import annotations

import shutil
import socket
import threading

import numpy as np
import yaml
from waiting import DEADLINE_S

from foveasim.studio._server import Studio, host_names
from foveasim.studio._session import Start

TOKEN = "the-token-of-these-tests-0123456"
TIMEOUT_MS = 1000 * DEADLINE_S
#: Number of Tab presses to an element, or to the field of a label: negative backwards, 0 if it has the focus.
N_TABS = """(selector) => {
  const text = selector.startsWith("label=") ? selector.slice(6) : null, { activeElement } = document;
  const all = text === null ? [...document.querySelectorAll(selector)]
    : [...document.querySelectorAll("label")].filter((label) => label.textContent.startsWith(text)).map((label) => label.control);
  if (all.includes(activeElement)) return 0;
  const target = all.find((element) => element.checkVisibility()) || document.body;
  const follows = (one, other) => one.compareDocumentPosition(other) & Node.DOCUMENT_POSITION_FOLLOWING;
  const isBack = activeElement.compareDocumentPosition(target) & Node.DOCUMENT_POSITION_PRECEDING;
  const [first, last] = isBack ? [target, activeElement] : [activeElement, target];
  const stops = [...document.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex]")].filter((each) =>
    each.tabIndex >= 0 && !each.disabled && !each.closest("[inert]") && each.checkVisibility({ visibilityProperty: true }));
  const n = 1 + stops.filter((each) => follows(first, each) && follows(each, last)).length;
  return isBack ? -n : n;
}"""
#: A foveal colour sensor of 1,152 photosites with design rules.
SHOT = yaml.safe_load("""
scene:
  kind: picture
  picture: skimage:astronaut
  pitch_um: 1000.0
  distance_m: 1.0
  peak_radiance_w_m2_sr_nm: 0.02
  wavelength_nm: [620, 550, 450]
optics: {focal_length_mm: 8.0, f_number: 2.8}
layout:
  generator: log_polar
  parameters: {n_sectors: 48, min_size_um: 8.0, r_max_um: 690.0, stagger: true, chords_per_arc: 2}
  mosaic: [RG, GB]
  rules: {min_size_um: 8.0, min_width_um: 7.0, angle_limit_deg: 60.0}
sensor:
  qe: {kind: silicon, depth_um: 3.0}
  filters: rgb
  capacitance_f: {per_um2: 1.0e-15}
  read_noise_e: 1.0
  v_sat_v: 3.0
  bits: 10
gaze_um: [-140.0, 320.0]
exposure_s: 0.02
seed: 1
""")


class Server:
    """The web server in a thread, which can be stopped and started again at the same address."""

    def __init__(self, out):
        self.start_of = Start(SHOT, "test", None, out)
        self.port = 0
        self.start()

    def start(self):
        import uvicorn

        listener = socket.create_server(("127.0.0.1", self.port), reuse_port=False)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.port = listener.getsockname()[1]
        self.studio = Studio(self.start_of, token=TOKEN, hosts=host_names("127.0.0.1", self.port))
        self.server = uvicorn.Server(
            uvicorn.Config(
                self.studio.app,
                log_level="critical",
                lifespan="off",
                access_log=False,
                ws="websockets-sansio",
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=0,
            )
        )
        self.thread = threading.Thread(target=self.server.run, kwargs={"sockets": [listener]}, daemon=True)
        self.thread.start()

    def stop(self):
        self.server.should_exit = self.server.force_exit = True
        self.thread.join(DEADLINE_S)
        self.studio.close()

    def reset(self):
        """Forget the pages and the files of a test."""
        with self.studio._opening:
            self.studio.close()
        shutil.rmtree(self.start_of.out)
        self.start_of.out.mkdir()

    @property
    def address(self):
        return f"http://127.0.0.1:{self.port}/#{TOKEN}"


def until(page, condition, argument=None):
    page.wait_for_function(condition, arg=argument, timeout=TIMEOUT_MS, polling=20)


def settle(page):
    """Wait until nothing more changes without the user: all answers, files and frames are there."""
    until(page, "() => window.studio?.isIdle")


def change(page, script, argument=None):
    """Run a script that sends messages, and wait for the answer to the last one."""
    page.evaluate(script, argument)
    settle(page)


def set_value(page, key, value):
    change(page, "([key, value]) => { studio.connection.set(key, value, true); }", [key, value])


def record_changes(page):
    """Record the changes of values that the page sends, with their times and the answers before them, in ``changes``."""
    page.evaluate("""() => { window.changes = []; const { connection } = studio, send = connection.send.bind(connection);
      connection.send = (message) => {
        if (message.do === "set") changes.push({ ...message, ms: performance.now(), nDone: connection.requests.nDone });
        return send(message);
      }; }""")


def hold_clock(page):
    """Stop the clock that recordings and films read; ``pass_time`` moves it."""
    page.evaluate(
        "() => { const now = performance.now(); window.passedMs = 0; performance.now = () => now + passedMs; }"
    )


def pass_time(page, time_ms):
    page.evaluate("time => { passedMs += time; }", time_ms)


def choose(page, label):
    """Select an option of the selection with the focus by arrow keys."""
    for _ in range(page.evaluate("document.activeElement.options.length")):
        distance = page.evaluate(
            "label => [...document.activeElement.options].findIndex((o) => o.label.startsWith(label)) - document.activeElement.selectedIndex",
            label,
        )
        if distance == 0:
            return
        page.keyboard.press("ArrowDown" if distance > 0 else "ArrowUp")
    raise AssertionError(f"the arrow keys do not reach {label}")


def forget_notice(page):
    """Remove the last notice, so that the same one can be awaited again."""
    page.evaluate("() => { document.getElementById('notice').textContent = ''; }")


def noticed(page, text):
    """Wait for a notice, which the page may have hidden since."""
    until(page, "text => document.getElementById('notice').textContent.includes(text)", text)


def setting(page, key):
    return page.evaluate("key => key.split('.').reduce((part, name) => part[name] ?? null, studio.state.settings)", key)


def codes(page):
    return np.array(page.evaluate("() => [...studio.panes.b.columns.find((c) => c.key === 'code').values]"))


def control(page, key, part="input[type=text]"):
    """Return an element of the last control of a key, after its section was opened."""
    row = page.locator(f".control[data-key='{key}']").last
    row.evaluate("row => { row.closest('details').open = true; }")
    return row.locator(part)


def has_picture(page, selector):
    """Whether the pixels of a canvas differ."""
    return page.evaluate(
        "selector => { const canvas = document.querySelector(selector), data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;"
        " const first = data.slice(0, 4).join(); for (let i = 0; i < data.length; i += 4) if (data.slice(i, i + 4).join() !== first) return true; return false; }",
        selector,
    )


def drop(page, name, content):
    page.evaluate(
        """([name, bytes]) => { const data = new DataTransfer(); data.items.add(new File([new Uint8Array(bytes)], name));
        for (const type of ["dragenter", "dragover", "drop"]) document.body.dispatchEvent(new DragEvent(type, { dataTransfer: data, bubbles: true, cancelable: true })); }""",
        [name, list(content)],
    )


class Keys:
    """A user without a mouse: reaches elements by Tab, and uses them by keys."""

    def __init__(self, page):
        self.page = page
        page.on("filechooser", lambda chooser: None)  # otherwise the interception may start after the key
        page.evaluate("() => { window.nPointed = 0; addEventListener('pointerdown', () => { nPointed++; }, true); }")

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def hold_tab(self, n, *, is_back):
        """Hold Tab until it has repeated a number of times."""
        if is_back:
            self.page.keyboard.down("Shift")
        for _ in range(n):
            self.page.keyboard.down("Tab")
        self.page.keyboard.up("Tab")
        if is_back:
            self.page.keyboard.up("Shift")

    def to(self, selector):
        """Move the focus to an element, or to the field of a label: ``"label=..."``."""
        for _ in range(100):  # the browser may have stops of its own, such as areas that scroll
            n_tabs = self.page.evaluate(N_TABS, selector)
            if n_tabs == 0:
                return
            self.hold_tab(abs(n_tabs), is_back=n_tabs < 0)
        raise AssertionError(f"Tab does not reach {selector}")

    def use(self, selector):
        """Press Enter on a button."""
        self.to(selector)
        self.press("Enter")
        self.wait()

    def type_in(self, selector, text):
        """Replace the text of a field."""
        self.to(selector)
        self.press("Control+a")
        self.page.keyboard.type(text)

    def enter(self, selector, text):
        """Replace the text of a field, and press Enter."""
        self.type_in(selector, text)
        self.press("Enter")
        self.wait()

    def choose(self, selector, label):
        """Select an option by its label."""
        self.to(selector)
        choose(self.page, label)
        self.wait()

    def set(self, key, text):
        """Enter the value of a control."""
        self.enter(f".control[data-key='{key}'] input[type=text]", text)

    def show(self, *names):
        """Show exactly these tiles."""
        for name in self.page.evaluate(
            "() => [...document.querySelectorAll('#tabs button')].map((b) => b.dataset.tile)"
        ):
            button = f"#tabs button[data-tile={name}]"
            if (name in names) != (self.page.get_attribute(button, "aria-pressed") == "true"):
                self.use(button)

    def menu(self, selector):
        """Move to an entry of the menu of files."""
        self.use("#file")
        for _ in range(20):
            if self.page.evaluate(N_TABS, selector) == 0:
                return
            self.press("ArrowDown")
        raise AssertionError(f"the menu has no {selector}")

    def open_file(self, path):
        """Open a file by the menu."""
        self.menu("[data-do=open]")
        with self.page.expect_file_chooser() as chooser:
            self.press("Enter")
        chooser.value.set_files(path)

    def download(self, selector, path):
        """Store a file of the menu."""
        self.menu(selector)
        with self.page.expect_download() as found:
            self.press("Enter")
        found.value.save_as(path)
        return path

    def wait(self):
        """Wait until the page shows the result of the last key."""
        settle(self.page)

    @property
    def n_pointed(self):
        return self.page.evaluate("nPointed")
