"""The command: its messages, without the extra, without a browser, and for other hosts."""

from __future__ import annotations

import queue
import socket
import stat
import sys
import threading
import webbrowser
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest
from typer.testing import CliRunner
from waiting import DEADLINE_S, wait_until

from foveasim import studio
from foveasim.cli import app
from foveasim.config import demo_settings
from foveasim.errors import ConfigError, FileError, FoveasimWarning, ParameterError
from foveasim.studio import _server, run_studio
from foveasim.studio._files import file_name, start_settings
from foveasim.studio._server import host_names


class Started(list):
    """The studios that were started; ``is_waiting``: set by a browser that does not return."""

    def __init__(self):
        super().__init__()
        self.is_waiting = threading.Event()


@pytest.fixture
def started(monkeypatch):
    """Record the studio instead of serving it."""
    found = Started()

    def record(served, _listener, announce):
        found.append(served)
        announce()
        for thread in threading.enumerate():
            if thread.name == "studio browser":  # its page is deleted with the server
                wait_until(lambda thread=thread: found.is_waiting.is_set() or not thread.is_alive())
        served.close()

    monkeypatch.setattr(_server, "serve", record)
    return found


class Browser:
    """Records the addresses that it opens."""

    def __init__(self, name, opened):
        self.name, self.opened = name, opened

    def open(self, address):
        path = Path(url2pathname(urlsplit(address).path))
        self.opened.put((path.read_text(), stat.S_IMODE(path.stat().st_mode)))


def no_browser():
    raise webbrowser.Error


def test_address_is_printed_without_browser(started, monkeypatch):
    monkeypatch.setattr("webbrowser.get", no_browser)
    result = CliRunner().invoke(app, ["studio"])

    assert result.exit_code == 0
    first, second = result.output.splitlines()
    assert first.startswith("studio at http://127.0.0.1:")
    assert first.endswith(f"/#{started[0].token} (press Ctrl-C to stop)")
    assert second == "no browser found; open the address in one"


@pytest.mark.parametrize(
    ("arguments", "is_shown"), [((), True), ((str(demo_settings()[1]),), False), (("--set", "sensor.bits=10"), False)]
)
def test_start_page_is_shown_without_settings(started, arguments, is_shown):
    CliRunner().invoke(app, ["studio", "--no-browser", *arguments])

    assert started[0].start.shows_start_page is is_shown


def test_browser_opens_address(started, monkeypatch):
    opened = queue.Queue()
    monkeypatch.setattr("webbrowser.get", lambda: Browser("firefox", opened))
    result = CliRunner().invoke(app, ["studio", str(demo_settings()[1])])

    # A file for this user: the arguments of a command are visible to all.
    page, mode = opened.get(timeout=DEADLINE_S)
    assert mode == 0o600
    assert f'url={result.output.split()[2]}"' in page
    assert "no browser" not in result.output
    assert started[0].start.name == "four_zones"


def test_text_browsers_are_not_opened(started, monkeypatch):
    monkeypatch.setattr("webbrowser.get", lambda: Browser("w3m", None))

    assert "no browser found" in CliRunner().invoke(app, ["studio"]).output


def test_waiting_browser_delays_nothing(started, monkeypatch):
    is_closed = threading.Event()
    browser = Browser("kiosk", queue.Queue())
    browser.open = lambda _: (started.is_waiting.set(), is_closed.wait(DEADLINE_S))
    monkeypatch.setattr("webbrowser.get", lambda: browser)
    result = CliRunner().invoke(app, ["studio"])
    is_closed.set()

    assert "studio at" in result.output


def test_no_browser_opens_none(started, monkeypatch):
    monkeypatch.setattr("webbrowser.get", lambda: pytest.fail("opened"))

    assert len(CliRunner().invoke(app, ["studio", "--no-browser"]).output.splitlines()) == 1


def test_tokens_are_random(started):
    for _ in range(2):
        run_studio(open_browser=False, announce=lambda *_: None)

    assert started[0].token != started[1].token
    assert len(started[0].token) == 32


def test_token_of_environment_is_used(started, monkeypatch):
    monkeypatch.setenv("FOVEASIM_STUDIO_TOKEN", "a-token_that_is_long_enough_1")
    run_studio(open_browser=False, announce=lambda *_: None)

    assert started[0].token == "a-token_that_is_long_enough_1"


@pytest.mark.parametrize("token", ["", "a" * 23, "a" * 24 + "&state=x", "ä" * 30])
def test_invalid_tokens_are_not_printed(monkeypatch, token):
    monkeypatch.setenv("FOVEASIM_STUDIO_TOKEN", token)
    result = CliRunner().invoke(app, ["studio", "--no-browser"])

    assert result.exit_code == 1
    assert "must have at least 24 characters" in str(result.exception)
    assert not token or token not in str(result.exception)


def test_directory_for_files_is_created_first(started, tmp_path):
    run_studio(out=tmp_path / "new" / "shots", open_browser=False, announce=lambda *_: None)

    assert list((tmp_path / "new").rglob("*")) == [tmp_path / "new" / "shots"]
    assert started[0].start.out == tmp_path / "new" / "shots"


def test_unwritable_directory_gives_one_line(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(studio.tempfile, "TemporaryFile", fail)

    with pytest.raises(FileError, match=r"cannot be written: Read-only file system$"):
        run_studio(out=tmp_path / "shots", open_browser=False)


def test_python_call_prints_address(started, capsys):
    run_studio(open_browser=False)

    assert capsys.readouterr().out.startswith("http://127.0.0.1:")


def test_missing_extra_gives_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)

    with pytest.raises(ParameterError, match=r"pip install 'foveasim\[studio\]'$"):
        run_studio()


def test_other_hosts_give_warning(started):
    with pytest.warns(FoveasimWarning, match="accessible from other computers"):
        run_studio(host="0.0.0.0", open_browser=False, announce=lambda *_: None)

    assert any(name.startswith(f"{socket.gethostname().lower()}:") for name in started[0].hosts)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_printed_address_is_reachable(monkeypatch, host):
    if host == "::" and not socket.has_ipv6:
        pytest.skip("this computer has no IPv6")
    connected = []

    def connect(served, _listener, announce):
        announce()
        served.close()

    def announce(address, _):
        name, _, port = address.removeprefix("http://").partition("/")[0].rpartition(":")
        with socket.create_connection((name.strip("[]"), int(port)), timeout=DEADLINE_S):
            connected.append(address)

    monkeypatch.setattr(_server, "serve", connect)
    with pytest.warns(FoveasimWarning):
        run_studio(host=host, open_browser=False, announce=announce)

    assert connected
    assert all(
        each.split("#")[0] in {f"http://{name}/" for name in host_names(host, port_of(each))} for each in connected
    )


def port_of(address):
    return urlsplit(address).port


def test_host_names_have_the_port():
    assert host_names("127.0.0.1", 5000) == {"127.0.0.1:5000", "localhost:5000", "[::1]:5000"}
    assert "localhost" in host_names("127.0.0.1", 80)


def test_used_port_gives_one_line():
    with socket.create_server(("127.0.0.1", 0)) as listener, pytest.raises(ParameterError, match="must be a free port"):
        run_studio(port=listener.getsockname()[1], open_browser=False)


@pytest.mark.parametrize("host", ["300.1.1.1", "192.0.2.1"])
def test_foreign_hosts_give_one_line(host):
    with (
        pytest.warns(FoveasimWarning),
        pytest.raises(ParameterError, match="'host' must be an address of this computer"),
    ):
        run_studio(host=host, open_browser=False)


def test_invalid_arguments_give_one_line(tmp_path):
    (tmp_path / "bad.yaml").write_text("scene: 5\n")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"bad\.yaml:1:1: scene"):
        run_studio(tmp_path / "bad.yaml", open_browser=False)
    with pytest.raises(FileError, match="missing"):
        run_studio(tmp_path / "missing.yaml", open_browser=False)
    with pytest.raises(FileError, match="cannot contain results"):
        run_studio(out=tmp_path / "file", open_browser=False)
    with pytest.raises(ParameterError, match="port"):
        run_studio(port=70000, open_browser=False)
    with pytest.raises(ParameterError, match="'host' must be an address of this computer, got ''"):
        run_studio(host="", open_browser=False)


def test_start_settings_have_absolute_paths(tmp_path):
    path = tmp_path / "shot.yaml"
    path.write_text(demo_settings()[0].read_text().replace("skimage:astronaut", "own.png"))

    settings, name = start_settings(path)

    assert settings["scene"]["picture"] == str(tmp_path / "own.png")
    assert name == "shot"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("../../etc/passwd", "passwd"),
        ("C:\\pictures\\My photo.JPG", "My_photo.jpg"),
        (".hidden", "file.hidden"),
        ("", "file"),
        ("..", "file"),
        ("a" * 300 + ".png", "a" * 120 + ".png"),
        ("Fovéa 網膜.PNG", "Fovéa_網膜.png"),
        ("網" * 300 + ".png", "網" * 40 + ".png"),
        ("fove\u0301a.png", "fovéa.png"),
        ("con.png", "con_.png"),
        ("COM1", "COM1_"),
        ("console.yaml", "console.yaml"),
    ],
)
def test_names_of_uploads_are_safe(given, expected):
    assert file_name(given) == expected
