"""Small settings, sessions without a thread, and pages in a browser."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from browsers import watch

from foveasim.studio import _session
from foveasim.studio._messages.encoding import decode_part
from foveasim.studio._messages.models import read_message
from foveasim.studio._session import Session, Start

SETTINGS = {
    "scene": {
        "kind": "checkerboard", "square_mm": 4.0, "shape": [64, 64], "pitch_um": 500.0, "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.02,
        "wavelength_nm": [620.0, 550.0, 450.0], "band_width_nm": 80.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "grid", "parameters": {"n_x": 16, "n_y": 14, "pitch_um": 12.0}, "mosaic": ["RG", "GB"],
        "rules": {"min_size_um": 10.0},
    },
    "sensor": {"qe": 0.6, "filters": "rgb", "bits": 10, "read_noise_e": 2.0, "capacitance_f": {"per_um2": 1e-15}},
    "exposure_s": 0.01,
    "seed": 3,
}  # fmt: skip


#: Views of the page in most tests.
FEW_VIEWS = ("sites", "columns", "picture", "comparison")
#: Marks tests with the views of a new page.
ALL_VIEWS = pytest.mark.parametrize("views", [None], ids=["all views"])


class Recorder:
    """A session whose messages are handled at once, and its answers; ``views``: those of the page, None for those of a new one."""

    def __init__(self, session, views=FEW_VIEWS):
        if views is not None:
            session.views.select(list(views))
        self.session = session
        self.messages, self.parts = [], []
        session._listeners[self._receive] = False
        self.do(do="refresh")

    def _receive(self, message):
        if isinstance(message, bytes):
            self.parts.append(decode_part(message))
        else:
            self.messages.append(json.loads(message))

    def do(self, **message):
        return self.handle([message])

    def handle(self, messages):
        self.messages.clear()
        self.parts.clear()
        self.session._handle([read_message(message) for message in messages])
        states = [message for message in self.messages if message["kind"] == "state"]
        return states[-1] if states else None

    @property
    def part_names(self):
        return [header["part"] for header, _ in self.parts]


class WithoutThread(Session):
    def _run(self):
        pass


@pytest.fixture
def settings():
    return json.loads(json.dumps(SETTINGS))


@pytest.fixture
def views():
    return FEW_VIEWS


@pytest.fixture
def make_session(settings, views, monkeypatch):
    monkeypatch.setattr(_session, "PROGRESS_S", -1.0)  # all stages
    made = []

    def make(out=None, directory=None, start=None):
        made.append(WithoutThread("test", Start(start or settings, "small", directory, out), n_threads=1))
        return Recorder(made[-1], views)

    yield make
    for session in made:
        session.close()


@pytest.fixture
def recorder(make_session):
    return make_session()


@pytest.fixture
def data_directory():
    return Path(__file__).parents[1]


# -- pages in a browser -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    from studio.page_tools import Server

    running = Server(tmp_path_factory.mktemp("out"))
    yield running
    running.stop()


@pytest.fixture
def visit(server, browser):
    """Open pages; at the end check that they wrote nothing to the console."""
    from studio.page_tools import TIMEOUT_MS, settle

    contexts, problems = [], []

    def open_page(*, width=1280, height=800, script=None, is_checked=True, address=None, **options):
        context = browser.new_context(
            viewport={"width": width, "height": height}, **{"bypass_csp": True, "reduced_motion": "reduce", **options}
        )
        contexts.append(context)
        if script:
            context.add_init_script(script)
        page = context.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        watch(page, problems, is_checked)
        page.goto(address or server.address)
        if options.get("bypass_csp", True) and address is None:  # otherwise its policy forbids to poll conditions
            settle(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    server.reset()
    assert problems == []
