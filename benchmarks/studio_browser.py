"""
The studio in Chromium: latency from a control to the drawn views, and a soak test with random changes.

    python benchmarks/studio_browser.py                 medians of 50 changes; 14,208 to 1,000,000 photosites
    python benchmarks/studio_browser.py --quick         5 changes, without bounds
    python benchmarks/studio_browser.py --soak 30       random changes for 30 minutes, with duplicated tabs and restarts of the
                                                        server: memory, console, stale views, codes
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import resource
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright
from report import Report
from rich.console import Console
from studio import CHANGES, N_CHANGES, N_QUICK, SENSORS, SETTINGS, SHOWN_MS, start_server

from foveasim.config import build_shot
from foveasim.studio._costs import FORGET_S, RELEASE_S

#: Arguments of Chromium: as installed for the latency; with WebGL by the processor for the soak test, which opens 3D views.
#: Without its own sandbox, because containers have no user namespaces.
INSTALLED = ("--no-sandbox",)
WEBGL = (*INSTALLED, "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-rasterization")
TIMEOUT_MS = 120_000
#: The server releases the results of sessions without a page, and returns unused memory, after a rest that is a little shorter.
REST_S = FORGET_S + RELEASE_S + 2.0
#: Interval at which the memory of the server is printed.
PRINT_S = 120.0
#: Changes that take longer are printed.
SLOW_S = 10.0
LEAK_MIB = 200.0
#: Time after which the soak test restarts the server, and the numbers of steps after which it duplicates the tab, refreshes the
#: views, and compares the codes with those of the settings.
RESTART_S, DUPLICATED, REFRESHED, COMPARED = 300.0, 15, 10, 20
#: Sends a change, and resolves to the times until the new values of the photosites are drawn, and until the frame with all
#: views is painted. The page tells when it is done: timers or frames that poll would take time from it.
CHANGE = """([key, value]) => new Promise((resolve) => {
  const { page, connection, views } = studio, { requests } = connection, start = performance.now();
  const property = { configurable: true, enumerable: true }, before = views.parts.columns;
  let { doneId } = requests, id = Infinity, drawn = NaN, { drawnAt } = page;
  const finish = () => {
    if (page.asked === null) resolve([drawn, performance.now() - start]);
    else setTimeout(finish, 2);
  };
  const set = (value) => {
    doneId = value;
    if (doneId < id) return;
    Object.defineProperty(requests, "doneId", { ...property, value, writable: true });
    Object.defineProperty(page, "drawnAt", { ...property, value: drawnAt, writable: true });
    setTimeout(finish);  // set at the beginning of a frame: after it
  };
  const setDrawn = (value) => {
    drawnAt = value;
    if (Number.isNaN(drawn) && views.parts.columns !== before) drawn = value - start;
  };
  Object.defineProperty(requests, "doneId", { ...property, get: () => doneId, set });
  Object.defineProperty(page, "drawnAt", { ...property, get: () => drawnAt, set: setDrawn });
  id = connection.set(key, value, true);
})"""
#: Sends messages, and resolves to null when the last one is done and drawn, and with a second argument also all previews
#: are complete and pictures have the size of their panes. After a minute it resolves to the state of the page, with the
#: longest time without a timer, and the number of frames that it draws in a second.
SEND = """([messages, isComplete]) => new Promise((resolve) => {
  const { page, connection } = studio;
  let nFrames = 0;
  for (const message of messages) connection.send(message);
  const id = connection.requests.lastId;  // also of messages that the page has sent, such as the choice of views
  const count = () => { nFrames++; requestAnimationFrame(count); };
  const describe = () => {
    const { isBusy, doneId, isPreview, draftId } = connection.requests, { isOpen } = connection;
    return { messages, id, doneId, isBusy, isPreview, isDrawn: page.asked === null, isOpen, draftId, longestGapMs };
  };
  const start = performance.now();
  let last = start, longestGapMs = 0;
  const step = () => {
    const now = performance.now();
    longestGapMs = Math.max(longestGapMs, now - last);
    last = now;
    const { isPreview, doneId, lastId } = connection.requests;
    const isFinal = !isPreview && !page.sizeTimer && doneId >= lastId;
    if (doneId >= id && studio.isReady && (isFinal || !isComplete)) resolve(null);
    else if (performance.now() - start < 60000) setTimeout(step, 5);
    else {
      const before = describe();
      count();
      setTimeout(() => resolve(JSON.stringify([before, describe(), nFrames])), 1000);
    }
  };
  step();
})"""
#: The arrays of all shown parts as text, for their comparison after a refresh.
PARTS = """() => {
  const bytes = (array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  const sum = (array) => bytes(array).reduce((total, byte) => (31 * total + byte) | 0, 7);
  const sums = (arrays) => Object.entries(arrays).map(([key, array]) => key + sum(array)).join();
  const text = ({ about, arrays }) => JSON.stringify(about) + sums(arrays);
  return Object.fromEntries(Object.entries(studio.views.parts).map(([name, part]) => [name, text(part)]));
}"""
READY = "window.studio && studio.isReady && studio.connection.isOpen && studio.connection.requests.nDone > 0"
STATE = "() => JSON.stringify(studio.state.settings)"
CODES = """() => Array.from(studio.panes.b.columns.find(({ key }) => key === "code").values)"""
CONTROLS = (
    "() => [...studio.controls.rows.values()].map(({ control, value }) => ({ ...control, value: value ?? null }))"
)
PRESETS = "() => [...document.querySelectorAll('#preset option')].map((option) => option.value).filter(Boolean)"
TILES = "() => [...document.querySelectorAll('#tabs button')].map((button) => button.dataset.tile)"
console = Console(width=130)


class Studio:
    """The server, and its page in Chromium."""

    def __init__(self, out: Path, arguments: tuple[str, ...]) -> None:
        self.token = secrets.token_urlsafe(24)
        self.options = ("--out", str(out))
        self.server, address = start_server(*self.options, token=self.token)
        self.port = address.split("/")[2].rpartition(":")[2]
        self.playwright = sync_playwright().start()
        browser = self.playwright.chromium.launch(
            executable_path=shutil.which("chromium-headless-shell") or shutil.which("chromium"), args=list(arguments)
        )
        context = browser.new_context(viewport={"width": 1440, "height": 900}, bypass_csp=True)
        context.add_init_script("localStorage.setItem('foveasim-studio-start', 'never')")  # the table at once
        self.page: Page = context.new_page()
        self.messages: list[str] = []
        self.page.on("console", lambda message: self._log(message.text))
        self.page.on("pageerror", lambda error: self._log(str(error)))
        self.page.goto(address)
        self.page.wait_for_function(READY, timeout=TIMEOUT_MS)
        self.start = self.page.evaluate("() => studio.page.state.settings")
        self.devtools = context.new_cdp_session(self.page)

    def _log(self, text: str) -> None:
        self.messages.append(text)
        console.print(f"console: {text}")

    def send(self, messages: list[dict[str, Any]], *, is_complete: bool = False, page: Page | None = None) -> bool:
        """Send messages, wait until they are done, or also all previews complete; return whether this took a minute."""
        problem = (page or self.page).evaluate(SEND, [messages, is_complete])
        if problem is not None:
            console.print(f"late: {problem}")
        return problem is not None

    def restart(self) -> None:
        """Restart the server at the same address, and wait for the page."""
        self.server.terminate()
        self.server.wait()
        self.server, _ = start_server(*self.options, "--port", self.port, token=self.token)
        self.page.wait_for_function(READY, timeout=TIMEOUT_MS)

    def duplicate(self) -> Page:
        """Duplicate the tab, and wait for the page."""
        with self.page.context.expect_page() as opened:
            self.page.evaluate("() => { open(location.href); }")
        found = opened.value
        found.on("pageerror", lambda error: self._log(str(error)))
        found.wait_for_function(READY, timeout=TIMEOUT_MS)
        return found

    def close(self) -> None:
        """End browser and server."""
        self.playwright.stop()
        self.server.terminate()
        self.server.wait()

    def server_mib(self) -> float:
        """Return the resident memory of the server, MiB."""
        n_pages = int(Path(f"/proc/{self.server.pid}/statm").read_text().split()[1])
        return n_pages * resource.getpagesize() / 2**20

    def memory_mib(self) -> tuple[float, float]:
        """Return the memory of the server and the heap of the page, MiB, at rest with the initial settings."""
        self.send([{"do": "unfreeze"}, {"do": "restore", "settings": self.start}])
        time.sleep(REST_S)
        self.devtools.send("HeapProfiler.collectGarbage")
        heap = self.devtools.send("Runtime.getHeapUsage")
        return self.server_mib(), (heap["usedSize"] + heap.get("backingStorageSize", 0)) / 2**20


def measure_latency(studio: Studio, report: Report, n: int) -> None:
    """Add the latency of changes to the report."""

    def add(label: str, time_ms: float, bound_ms: float, about: str = "bound") -> None:
        report.add(label, f"{time_ms:.0f} ms", about, f"{bound_ms:g} ms", time_ms / bound_ms, 1.0)

    for sensor, sections in SENSORS.items():
        for key, section in sections.items():
            _, shown_ms = studio.page.evaluate(CHANGE, [key, section])
            if sensor in SHOWN_MS:
                add(f"{sensor} photosites: shown", shown_ms, SHOWN_MS[sensor])
        for name, bound_ms, map_bound_ms in CHANGES[sensor]:
            key, value = SETTINGS[name]
            times = [studio.page.evaluate(CHANGE, [key, value(k)]) for k in range(n + 2)][2:]
            drawn_ms, all_ms = np.median(times, axis=0)
            add(f"{sensor} photosites: {name}", all_ms, bound_ms, f"bound; photosites {drawn_ms:.0f} ms")
            if map_bound_ms is not None:
                add(f"{sensor} photosites: {name}, the map", drawn_ms, map_bound_ms)


def random_messages(rng: random.Random, studio: Studio, page: Page) -> list[dict[str, Any]]:
    """Return one to five random messages of a user."""
    controls = page.evaluate(CONTROLS)
    numbers = [c for c in controls if c["kind"] in ("number", "integer") and c["value"] is not None]
    numbers = [c for c in numbers if not c["key"].startswith("layout")]
    choices, presets = _choices(controls), _presets(studio)

    def number() -> dict[str, Any]:
        control = rng.choice(numbers)
        low, high = control["suggested"]
        value = low + (high - low) * rng.random()
        value = round(value) if control["kind"] == "integer" else float(f"{value:.4g}")
        return {"do": "set", "key": control["key"], "value": value, "final": rng.random() < 0.5}

    def choice() -> dict[str, Any]:
        control = rng.choice(choices)
        return {"do": "set", "key": control["key"], "value": rng.choice(control["choices"])["value"], "final": True}

    def edit() -> dict[str, Any]:
        state = page.evaluate("() => studio.page.state")
        x0, y0, x1, y1 = state["summary"]["bounds_um"]
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        outline = [[x, y], [x + 20.0, y], [x + 10.0, y + 15.0]]
        edits = [*state["settings"]["layout"].get("edits", []), {"kind": "draw", "outlines_um": [outline]}][-8:]
        return {"do": "set", "key": "layout.edits", "value": edits, "final": True}

    def gaze() -> dict[str, Any]:
        return {
            "do": "set",
            "key": "gaze_um",
            "value": [rng.uniform(-200, 200), rng.uniform(-200, 200)],
            "final": True,
        }

    others = [{"do": "undo"}, {"do": "redo"}, {"do": "freeze"}, {"do": "unfreeze"}, {"do": "reset", "key": "sensor"}]
    made = []
    for _ in range(rng.randint(1, 5)):
        kind = rng.random()
        if kind < 0.5:
            made.append(number())
        elif kind < 0.6:
            made.append(choice())
        elif kind < 0.7:
            made.append(edit())
        elif kind < 0.85:
            made.append(gaze())
        elif kind < 0.97:
            made.append(rng.choice(others))
        else:
            made.append({"do": "preset", "name": rng.choice(presets)})
    return made


def _choices(controls: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the controls with choices, without those of layout and scene, which presets change."""
    return [c for c in controls if c["kind"] == "choice" and not c["key"].startswith(("layout", "scene"))]


def _presets(studio: Studio) -> list[str]:
    """Return the names of the presets, without layouts that take some seconds each."""
    return [name for name in studio.page.evaluate(PRESETS) if "pixirad" not in name and "wave" not in name]


def warm_up(studio: Studio) -> None:
    """Show each view, preset and choice once: modules and kernels are then loaded, which is not growth."""
    for tile in studio.page.evaluate(TILES):
        studio.page.click(f"#tabs button[data-tile='{tile}']")
        studio.send([])
    for name in _presets(studio):
        studio.send([{"do": "preset", "name": name}])
    studio.send([{"do": "restore", "settings": studio.start}])
    for control in _choices(studio.page.evaluate(CONTROLS)):
        for choice in control["choices"]:
            studio.send([{"do": "set", "key": control["key"], "value": choice["value"], "final": True}])
        studio.send([{"do": "restore", "settings": studio.start}])


class Soak:
    """Random changes of a page, and what went wrong."""

    def __init__(self, studio: Studio, seed: int) -> None:
        self.studio, self.seed, self.rng = studio, seed, random.Random(seed)
        self.n_steps = self.n_late = 0
        # Checks by name: how many failed, of how many.
        self.checks: dict[str, list[int]] = {}
        warm_up(studio)
        self.first_mib = studio.memory_mib()
        self.grown_mib = 0.0

    def check(self, name: str, is_fine: bool) -> None:
        """Count a check."""
        found = self.checks.setdefault(name, [0, 0])
        found[0] += not is_fine
        found[1] += 1
        if not is_fine:
            console.print(f"step {self.n_steps}: {name}")

    def step(self, page: Page) -> None:
        """Make some changes."""
        messages, start_s = random_messages(self.rng, self.studio, page), time.monotonic()
        self.n_late += self.studio.send(messages, page=page)
        self.n_steps += 1
        if (time_s := time.monotonic() - start_s) > SLOW_S:
            changed = ", ".join(
                f"{m['do']} {m.get('key', m.get('name', ''))} {m.get('value', '')}"[:60] for m in messages
            )
            console.print(f"step {self.n_steps}: {time_s:.0f} s for {changed}")

    def refresh(self, page: Page) -> None:
        """Compare the views with those that the server sends again."""
        # A preview is shown as such until the complete result replaces it.
        self.n_late += self.studio.send([], is_complete=True, page=page)
        before = page.evaluate(PARTS)
        self.studio.send([{"do": "refresh"}], page=page)
        after = page.evaluate(PARTS)
        stale = [name for name in before if name in after and _digest(before[name]) != _digest(after[name])]
        self.check("stale views", not stale)
        if stale:
            console.print(f"stale {stale}")

    def compare(self, page: Page) -> None:
        """Compare the codes with those of the settings in this process."""
        self.n_late += self.studio.send([], is_complete=True, page=page)
        self.check("codes other than those of the settings", _is_equal(page))

    def duplicate(self) -> None:
        """Change a duplicated tab, which is another session with the same state."""
        self.n_late += self.studio.send([], is_complete=True)
        before, page = self.studio.page.evaluate(STATE), self.studio.duplicate()
        self.check("duplicated tabs with another state", page.evaluate(STATE) == before)
        for _ in range(3):
            self.step(page)
        self.refresh(page)
        self.compare(page)
        page.close()
        self.check("changes of duplicated tabs in others", self.studio.page.evaluate(STATE) == before)
        self.refresh(self.studio.page)

    def restart(self) -> None:
        """Restart the server: the page restores its state."""
        self.measure()
        self.n_late += self.studio.send(random_messages(self.rng, self.studio, self.studio.page))
        self.studio.send([], is_complete=True)
        before = self.studio.page.evaluate(STATE)
        self.studio.restart()
        self.n_late += self.studio.send([], is_complete=True)
        self.check("states that are lost at a restart", self.studio.page.evaluate(STATE) == before)
        self.compare(self.studio.page)

    def measure(self) -> None:
        """Compare the memory with that after all views, presets and choices."""
        found = self.studio.memory_mib()
        self.grown_mib = max(self.grown_mib, sum(found) - sum(self.first_mib))
        console.print(f"{self.n_steps} steps: server {found[0]:.0f} MiB, page {found[1]:.0f} MiB")

    def report(self, report: Report) -> None:
        """Add the results to the report."""
        bound = f"{LEAK_MIB:g} MiB"
        report.add("soak: memory growth", f"{self.grown_mib:.0f} MiB", "bound", bound, self.grown_mib / LEAK_MIB, 1.0)
        self.checks["console messages"] = [len(self.studio.messages), self.n_steps]
        self.checks["answers later than a minute"] = [self.n_late, self.n_steps]
        for name, (n_found, n_of) in self.checks.items():
            report.add(f"soak: {name}", f"{n_found} of {n_of}", "none", "0", float(n_found > 0) * 2.0, 1.0)


def soak(studio: Studio, report: Report, minutes: float, seed: int, out: Path) -> None:
    """Make random changes, and add memory, console messages, stale views and differences of codes to the report."""
    warnings.simplefilter("ignore")  # of random settings
    run = Soak(studio, seed)
    console.print(
        f"after every view, preset and choice: server {run.first_mib[0]:.0f} MiB, page {run.first_mib[1]:.0f} MiB; seed {seed}"
    )
    start_s = printed_s = restarted_s = time.monotonic()
    while (now_s := time.monotonic()) - start_s < 60.0 * minutes:
        run.step(studio.page)
        if run.n_steps % 3 == 0:
            tile = run.rng.choice(studio.page.evaluate(TILES))
            studio.page.click(f"#tabs button[data-tile='{tile}']")
        if run.n_steps % REFRESHED == 0:
            run.refresh(studio.page)
        if run.n_steps % COMPARED == 0:
            run.compare(studio.page)
        if run.n_steps % DUPLICATED == 0:
            run.duplicate()
        if now_s - restarted_s > RESTART_S:
            run.restart()
            restarted_s = time.monotonic()
        if now_s - printed_s > PRINT_S:
            printed_s = now_s
            console.print(f"{now_s - start_s:.0f} s, {run.n_steps} steps: server {studio.server_mib():.0f} MiB")
    studio.send([{"do": "save", "name": "soak.yaml"}, {"do": "refresh"}])
    codes = np.array(studio.page.evaluate(CODES))
    command = [sys.executable, "-m", "foveasim", "run", str(out / "soak.yaml"), "--out", str(out / "results")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    run.check("codes other than those of foveasim run", np.array_equal(codes, _codes_of_run(out / "results")))
    run.measure()
    run.report(report)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _is_equal(page: Page) -> bool:
    """Return whether the codes of the page are those of its settings in this process."""
    settings = json.loads(page.evaluate(STATE), parse_float=float)
    settings = _with_infinities(settings)
    shot = build_shot(None, settings)
    codes = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code
    return np.array_equal(np.array(page.evaluate(CODES)), codes)


def _with_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _with_infinities(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_with_infinities(item) for item in value]
    return {".inf": float("inf"), "-.inf": -float("inf")}.get(value, value) if isinstance(value, str) else value


def _codes_of_run(directory: Path) -> Any:
    with np.load(next(directory.glob("*.npz")), allow_pickle=False) as results:
        return results["code"]


def main() -> int:
    """Print the table; exit with 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--soak", type=float, metavar="MINUTES")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    report = Report(is_judged=not options.quick)
    with tempfile.TemporaryDirectory() as directory:
        studio = Studio(Path(directory), WEBGL if options.soak else INSTALLED)
        try:
            if options.soak:
                soak(studio, report, options.soak, options.seed, Path(directory))
            else:
                measure_latency(studio, report, N_QUICK if options.quick else N_CHANGES)
        finally:
            studio.close()
    console.print(report.table)
    return min(report.missed, 1)


if __name__ == "__main__":
    sys.exit(main())
