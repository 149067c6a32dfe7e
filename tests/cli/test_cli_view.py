"""The command view: pages that it writes and serves, and arguments that it rejects."""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import run_here
from waiting import DEADLINE_S, wait_until

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.view.web import open_page, serve_page

LAYOUT = fs.layout.grid(n_x=6, n_y=5, pitch_um=2.0)


@pytest.fixture
def view(folder, monkeypatch, capsys):
    """Run the command in this process: exit code, standard output, standard error."""

    def run(*arguments):
        ended = run_here(monkeypatch, capsys.readouterr, "view", *arguments, cwd=folder)
        return ended.returncode, ended.stdout, ended.stderr

    return run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    LAYOUT.write(folder / "layout.geojson")
    LAYOUT.write(folder / "layout.npz")
    LAYOUT.check(fs.DesignRules(min_size_um=3.0)).write(folder / "report.lyrdb")
    (folder / "rules.yaml").write_text("{min_size_um: 3.0}")
    (folder / "text.txt").write_text("nothing to see")
    capture = fs.Capture(
        layout=LAYOUT,
        code=np.arange(30, dtype=np.uint8),
        electrons=np.arange(30) * 10,
        expected_e=np.arange(30) * 10.0,
        filter_of_site=np.zeros(30, np.int64),
        filter_names=("all",),
        bits=8,
        white_dn=np.array([255.0]),
        settings={},
    )
    capture.save(folder / "capture.npz")
    return folder


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["layout.geojson"], ["30 photosites", '"kind": "layout"']),
        (["layout.npz"], ["30 photosites", '"kind": "layout"']),
        (["quad_bayer"], ["<title>quad_bayer</title>", "photosites"]),
        (["capture.npz"], ["30 photosites", '"kind": "capture"', "expected electrons"]),
        (["layout.npz", "--rules", "rules.yaml"], ["min_size_um", '"count": 30']),
        (["report.lyrdb", "--layout", "layout.npz"], ["min_size_um", '"count": 30']),
        (["layout.npz", "--solid"], ["30 photosites", "z points toward the lens"]),
        (["capture.npz", "--solid"], ["30 photosites", "Column heights show the codes"]),
    ],
    ids=lambda value: " ".join(value) if "photosites" not in " ".join(value) else "",
)
def test_view_writes_page_of_any_file(view, tmp_path, arguments, words):
    code, said, complaint = view(*arguments, "--out", str(tmp_path / "out.html"))

    assert (code, complaint) == (0, "")
    assert said.strip() == f"wrote {tmp_path / 'out.html'}"
    text = (tmp_path / "out.html").read_text()
    assert [word for word in words if word not in text] == []


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nothing.gds"], "nothing.gds: no such file"),
        (["text.txt"], "text.txt: is not a valid layout file"),
        (["capture.npz", "--out", "page.txt"], "page.txt: must end in .html"),
        (["capture.npz", "--out", "nowhere/page.html"], "the directory nowhere does not exist"),
        (["capture.npz", "--out", "a.html", "--serve"], "--out and --serve exclude each other"),
        (["capture.npz", "--port", "8000"], "--port requires --serve"),
        (["capture.npz", "--serve", "--port", "70000"], "'port' must be <= 65535"),
        (["layout.npz", "--solid", "--rules", "rules.yaml"], "--solid shows no violations"),
        (["report.lyrdb"], "'layout' must be given"),
        (["report.lyrdb", "--layout", "layout.npz", "--rules", "rules.yaml"], "'rules' must be omitted for a report"),
        (["layout.npz", "--layout", "layout.npz"], "'layout' must be omitted: layout.npz is not a report"),
        (["layout.npz", "--rules", "nothing.yaml"], "nothing.yaml: no such file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_invalid_view_arguments_print_one_line(view, folder, arguments, sentence):
    before = sorted(folder.iterdir())
    code, said, complaint = view(*arguments)

    assert (code, said) == (2, "")
    assert complaint.startswith("error: ")
    assert complaint.count("\n") == 1
    assert sentence in complaint
    assert sorted(folder.iterdir()) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_directory_prints_one_line(view, tmp_path):
    tmp_path.chmod(0o500)
    code, _, complaint = view("layout.npz", "--out", str(tmp_path / "out.html"))

    assert code == 2
    assert "cannot be written" in complaint


def test_page_over_directory_is_rejected(view, tmp_path):
    (tmp_path / "out.html").mkdir()
    code, _, complaint = view("layout.npz", "--out", str(tmp_path / "out.html"))

    assert code == 2
    assert "it is a directory" in complaint
    assert [p.name for p in tmp_path.iterdir()] == ["out.html"]


@pytest.mark.slow
def test_page_is_served_on_localhost(view, folder):
    command = [sys.executable, "-m", "foveasim.cli", "view", "layout.npz", "--serve"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            line = server.stdout.readline()
            assert re.fullmatch(r"serving layout.npz at http://127.0.0.1:\d+/ \(press Ctrl-C to stop\)\n", line)
            address = line.split(" ")[3].rstrip(";")
            port = int(address.rsplit(":", 1)[1].strip("/"))
            with urllib.request.urlopen(address) as answer:
                assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
                assert b"30 photosites" in answer.read()
            with pytest.raises(urllib.error.HTTPError, match="404") as rejected:
                urllib.request.urlopen(address + "layout.npz")
            rejected.value.close()
            # A foreign host name that resolves to this machine: DNS rebinding.
            connection = http.client.HTTPConnection("127.0.0.1", port)
            connection.request("GET", "/", headers={"Host": f"foreign.example:{port}"})
            assert connection.getresponse().status == 403
            connection.close()
            # The same port for a second server.
            code, _, complaint = view("layout.npz", "--serve", "--port", str(port))
            assert code == 2
            assert "'port' must be a free port" in complaint
        finally:
            server.send_signal(signal.SIGINT)
            rest, errors = server.communicate(timeout=DEADLINE_S)

    assert server.returncode == 0
    assert (rest, errors) == ("", "")


def test_page_opens_in_browser_by_default(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    opened = []
    for has_browser in (True, False):
        monkeypatch.setattr("webbrowser.open", lambda address, found=has_browser: opened.append(address) or found)
        path, is_opened = open_page("<p>µ</p>")
        assert is_opened == has_browser
        assert path.read_text(encoding="utf-8") == "<p>µ</p>"
        assert opened[-1] == path.as_uri()


def test_invalid_port_is_rejected():
    with pytest.raises(ParameterError, match="'port' must be >= 0"):
        serve_page("", port=-1, announce=print)


# -- client connections ---------------------------------------------------------------------------------------------------

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="asks the system for its connections and threads")
#: More than the buffers of both ends hold.
BIG_BYTES = 20_000_000
SERVER = f"""
from foveasim.view.web import _serve
_serve.TIMEOUT_S = {{patience_s}}
_serve.serve_page("x" * {BIG_BYTES}, announce=lambda address: print(address, flush=True))
"""


@contextlib.contextmanager
def servers_in_processes():
    """Start servers in separate processes; each exits with 0 on Ctrl-C and prints nothing."""
    servers = []

    def start(patience_s=DEADLINE_S):
        code = SERVER.format(patience_s=patience_s)
        server = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        servers.append(server)
        return int(server.stdout.readline().rsplit(":", 1)[1].strip().strip("/")), server

    yield start
    endings = []
    for server in servers:
        server.send_signal(signal.SIGINT)
        try:
            endings.append((*server.communicate(timeout=DEADLINE_S), server.returncode))
        finally:
            server.kill()
    assert endings == [("", "", 0)] * len(servers)


@pytest.fixture
def serve():
    with servers_in_processes() as start:
        yield start


@pytest.fixture(scope="module")
def served_port():
    """Return the port of one server for several tests."""
    with servers_in_processes() as start:
        yield start()[0]


def connect(port, text="", host="127.0.0.1"):
    connection = socket.create_connection((host, port), timeout=DEADLINE_S)
    connection.sendall(text.encode())
    return connection


def ask(port, host=None, first="GET / HTTP/1.1", more=""):
    """Return the response of a server to one request."""
    with connect(port, f"{first}\r\nHost: {host or f'127.0.0.1:{port}'}\r\n{more}\r\n") as connection:
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


@pytest.mark.slow
def test_served_page_survives_clients_that_reset(served_port):
    for n_bytes in (0, 1, 100_000):
        for _ in range(5):
            connection = connect(served_port, f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{served_port}\r\n\r\n")
            if n_bytes:
                connection.recv(n_bytes)
            # Close with a TCP reset.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
    head, _, body = ask(served_port).partition(b"\r\n\r\n")

    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert len(body) == BIG_BYTES


@pytest.mark.slow
@on_linux
def test_half_sent_requests_are_dropped(serve):
    port, _ = serve(patience_s=0.3)
    with contextlib.ExitStack() as stack:
        halves = [
            stack.enter_context(connect(port, text)) for text in ("", "GET / HTTP", "GET / HTTP/1.1\r\nHost: x\r\n")
        ]
        for half in halves:
            with contextlib.suppress(ConnectionResetError):
                assert half.recv(1) == b""
        # A client that does not read is dropped too, before the page is sent.
        idle = stack.enter_context(connect(port, f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"))
        wait_until(lambda: n_connections(port) == 0)
        got = 0
        with contextlib.suppress(ConnectionResetError):
            while piece := idle.recv(1 << 20):
                got += len(piece)
        assert got < BIG_BYTES


def n_connections(port):
    """Return the number of open connections of a server, from the operating system."""
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    return sum(line.split()[1] == f"0100007F:{port:04X}" and line.split()[3] == "01" for line in lines)


@pytest.mark.slow
@on_linux
def test_idle_connections_leave_the_page_served(serve):
    port, server = serve()
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(connect(port, "GET /" * (i % 2))) for i in range(100)]
        assert ask(port).startswith(b"HTTP/1.1 200 OK\r\n")
        assert len(list(Path(f"/proc/{server.pid}/task").iterdir())) < 20
        idle += [stack.enter_context(connect(port)) for _ in range(40)]
        assert ask(port).startswith(b"HTTP/1.1 503 Service Unavailable\r\n")
        for connection in idle[:60]:
            connection.close()
        wait_until(lambda: ask(port).startswith(b"HTTP/1.1 200 OK\r\n"))


REQUESTS = [
    ({"host": "other.example"}, b"403"),
    ({"host": "127.0.0.1"}, b"403"),
    ({"host": "127.0.0.1:1"}, b"403"),
    ({"more": "Host: other.example\r\n"}, b"400"),
    ({"first": "GET / HTTP/1.1\r\nhost: other.example"}, b"400"),
    ({"first": "nonsense"}, b"400"),
    ({"first": "GET /layout.npz HTTP/1.1"}, b"404"),
    ({"first": "POST / HTTP/1.1"}, b"405"),
    ({"more": f"X: {'x' * 20_000}\r\n"}, b"431"),
    ({"first": "HEAD / HTTP/1.1"}, b"200"),
]


def test_served_page_answers_one_request_alone(served_port):
    for request, status in REQUESTS:
        answer = ask(served_port, **request)
        assert answer.split(b" ", 2)[1] == status, request
        assert len(answer) < 1000
    assert ask(served_port, f"LOCALHOST:{served_port}").startswith(b"HTTP/1.1 200")


@pytest.mark.slow
@on_linux
def test_served_page_listens_on_one_address(served_port):
    # 127.0.0.0/8 is this machine: a server on all addresses would answer.
    with pytest.raises(ConnectionRefusedError):
        connect(served_port, host="127.0.0.2")


@pytest.mark.slow
def test_ctrl_c_ends_busy_server(serve):
    port, server = serve()
    with connect(port), connect(port, f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n") as reading:
        reading.recv(10)
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=DEADLINE_S) == 0
