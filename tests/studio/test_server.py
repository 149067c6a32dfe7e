"""The server: token, headers, limits, files, several pages, and a restart."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import websockets
import yaml
from waiting import DEADLINE_S, wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus

import foveasim as fs
from foveasim._io.images import write_picture
from foveasim.config import build_shot
from foveasim.studio import _server
from foveasim.studio._messages.encoding import decode_part
from foveasim.studio._server import HEADERS, Studio, host_names, other_addresses, serve
from foveasim.studio._session import Start

TIMEOUT_S = DEADLINE_S
#: Open connections of a test.
CONNECTIONS = []


class Served:
    """A studio in a thread of this process."""

    def __init__(self, start):
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.studio = Studio(start, hosts=host_names("127.0.0.1", self.port))
        self.host = f"127.0.0.1:{self.port}"
        self.is_ready = threading.Event()
        self.servers = []
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()
        assert self.is_ready.wait(TIMEOUT_S)

    def _serve(self):
        serve(self.studio, self.listener, self.is_ready.set, self.servers.append)

    def stop(self):
        self.servers[0].should_exit = True
        self.thread.join(TIMEOUT_S)
        self.listener.close()

    def get(self, path, data=None, **headers):
        request = urllib.request.Request(f"http://{self.host}{path}", data, headers)
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                return answer.status, lower(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            return error.code, lower(error.headers), error.read()

    def authorised(self, session, path, data=None, **headers):
        return self.get(path, data, **{"Authorization": f"Bearer {self.studio.token}", "X-Session": session, **headers})


def lower(headers):
    return {name.lower(): value for name, value in headers.items()}


class Page:
    """A connection as of a browser."""

    def __init__(self, connection):
        self.connection = connection
        self.hello, self.state, self.parts, self.messages = None, None, {}, []

    async def until(self, kind):
        while True:
            message = await asyncio.wait_for(self.connection.recv(), TIMEOUT_S)
            if isinstance(message, bytes):
                header, arrays = decode_part(message)
                self.parts[header["part"]] = header, arrays
                continue
            found = json.loads(message)
            self.messages.append(found)
            if found["kind"] == "state":
                self.state = found
            if found["kind"] == kind:
                return found

    async def do(self, kind="done", **message):
        await self.connection.send(json.dumps(message))
        return await self.until(kind)

    @property
    def code(self):
        header, arrays = self.parts["columns"]
        return arrays[next(column["array"] for column in header["about"]["columns"] if column["key"] == "code")]


async def opened(served, session=None, token=None, page=None):
    connection = await websockets.connect(f"ws://{served.host}/socket", max_size=None)
    CONNECTIONS.append(connection)
    await connection.send(json.dumps({"token": token or served.studio.token, "session": session, "page": page}))
    page = Page(connection)
    page.hello = await page.until("hello")
    await page.until("done")
    return page


async def bounded(coroutine):
    try:
        return await asyncio.wait_for(coroutine, TIMEOUT_S)
    finally:
        while CONNECTIONS:
            await CONNECTIONS.pop().close()


def run(coroutine):
    return asyncio.run(bounded(coroutine))


@pytest.fixture
def start(settings):
    return Start(settings, "small")


@pytest.fixture
def served(start):
    found = Served(start)
    yield found
    found.stop()


def codes_of(settings):
    shot = build_shot(None, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def test_pages_have_security_headers(served):
    for path in (
        "/",
        "/static/index.html",
        "/web/map.js",
        "/static/views/mtf.js",
        "/static/views/missing.js",
        "/static/missing.js",
    ):
        status, headers, content = served.get(path)
        assert status == (404 if "missing" in path else 200)
        assert {headers[name.lower()] for name in HEADERS} == set(HEADERS.values())
        assert content
    permitted = dict(item.split("=") for item in headers["permissions-policy"].split(", "))
    assert {name for name, origins in permitted.items() if origins != "()"} == {"camera"}
    assert permitted["camera"] == "(self)"


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize(
    "path",
    ["/static/..%2f__init__.py", "/static/%2e%2e/_server.py", "/static/views/..%2findex.html", "/web/_serve.py", "/web/..%2f..%2fcli.py", "/web/template.html", "/static/", "/file", "/static/.js", "/x"],
)  # fmt: skip
def test_other_files_are_not_served(served, path):
    assert served.get(path)[0] in (404, 405)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    ("name", "value", "status"),
    [
        ("Host", "example.org", 403),
        ("Host", "127.0.0.1", 403),
        ("Host", "127.0.0.1:1", 403),
        ("Origin", "http://example.org", 403),
        ("Origin", "null", 403),
        ("Origin", "https://HOST", 403),
        ("Origin", "http://HOST", 200),
    ],
)
def test_other_hosts_and_origins_are_rejected(served, name, value, status):
    headers = {name: value.replace("HOST", served.host)}
    assert served.get("/", **headers)[0] == status

    async def connect():
        address = f"ws://{served.host}/socket"
        async with websockets.connect(address, additional_headers=headers if name == "Origin" else {}):
            pass

    if name == "Origin":
        if status == 200:
            run(connect())
        else:
            with pytest.raises(InvalidStatus, match="403"):
                run(connect())


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    "first", ['{"token": "wrong"}', "{}", "[]", "x", '{"token": 5}', '{"token": "é"}', r'{"token": "\ud800"}']
)
def test_wrong_tokens_close_the_socket(served, first):
    async def attempt():
        async with websockets.connect(f"ws://{served.host}/socket") as connection:
            await connection.send(first)
            await connection.recv()

    with pytest.raises(ConnectionClosed) as caught:
        run(attempt())

    assert caught.value.rcvd.code == 4403
    assert served.studio.sessions == {}


def test_page_receives_state_and_parts(served, settings):
    async def visit():
        page = await opened(served)
        await page.do(do="set", key="exposure_s", value=0.02, final=True, id=1)
        await page.connection.close()
        return page

    page = run(visit())

    assert {"session", "version", "controls", "presets", "views", "can_save", "is_new"} <= set(page.hello)
    assert page.hello["is_new"]
    assert page.state["id"] == 1
    assert np.array_equal(page.code, codes_of({**settings, "exposure_s": 0.02}))


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    "text", ["", "{", "null", "[1]", "NaN", '"x"', "1" * 5000, "[" * 5000, '{"do": "set", "value": Infinity}']
)
def test_malformed_messages_give_errors(served, text):
    async def visit():
        page = await opened(served)
        await page.connection.send(text)
        error = await page.until("error")
        await page.until("done")
        await page.do(do="set", key="seed", value=5, final=True)
        await page.connection.close()
        return error, page.state

    error, state = run(visit())
    assert "\n" not in error["text"]
    assert state["settings"]["seed"] == 5


def test_large_messages_close_the_connection(served):
    async def visit():
        page = await opened(served)
        await page.connection.send("x" * (_server.MAX_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed):
            await page.until("nothing")
        again = await opened(served, page.hello["session"])
        await again.connection.close()
        return again.hello["is_new"]

    assert run(visit()) is False


def test_second_connection_restores_session(served):
    async def visit():
        first = await opened(served)
        await first.do(do="set", key="exposure_s", value=0.03, final=True)
        await first.connection.close()
        second = await opened(served, first.hello["session"])
        await second.connection.close()
        return first, second

    first, second = run(visit())
    assert not second.hello["is_new"]
    assert second.state["settings"]["exposure_s"] == 0.03
    assert np.array_equal(first.code, second.code)


@pytest.mark.slow
def test_tabs_have_separate_sessions(served, settings):
    async def visit():
        one, two = await opened(served), await opened(served)
        await one.do(do="set", key="exposure_s", value=0.03, final=True)
        await two.do(do="set", key="seed", value=8, final=True)
        for page in (one, two):
            await page.connection.close()
        return one, two

    one, two = run(visit())
    assert one.hello["session"] != two.hello["session"]
    assert np.array_equal(one.code, codes_of({**settings, "exposure_s": 0.03}))
    assert np.array_equal(two.code, codes_of({**settings, "seed": 8}))


def test_short_messages_do_not_wait(served):
    """Nagle's algorithm would hold a short message after a large one until that is acknowledged."""
    with socket.create_connection(("127.0.0.1", served.port)):
        connection = wait_until(lambda: list(served.studio.unauthenticated._transports.values()))[0].get_extra_info(
            "socket"
        )

        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


@pytest.mark.slow
def test_duplicated_tab_has_a_copy(served, settings, tmp_path):
    """Both pages have the same state at first, files included, and change separately."""
    write_picture(tmp_path / "photo.png", np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8))

    async def visit():
        one = await opened(served, page="one")
        name = one.hello["session"]
        answer = await asyncio.to_thread(
            served.authorised, name, "/file?name=photo.png", (tmp_path / "photo.png").read_bytes()
        )
        await one.do(do="set", key="exposure_s", value=0.02, final=True)
        await one.do(do="file", path=json.loads(answer[2])["path"], **{"as": "scene"})
        two = await opened(served, name, page="two")
        copied = two.state["settings"]
        await one.do(do="set", key="exposure_s", value=0.03, final=True)
        await two.do(do="set", key="seed", value=8, final=True)
        await one.connection.close()
        await asyncio.to_thread(wait_until, lambda: served.studio.sessions[name].is_idle)
        again = await opened(served, name, page="three")  # the page was loaded again
        for page in (two, again):
            await page.connection.close()
        return one, two, again, copied

    one, two, again, copied = run(visit())
    assert one.hello["session"] != two.hello["session"]
    assert again.hello["session"] == one.hello["session"]
    assert not two.hello["is_new"]
    assert two.state["can_undo"]
    assert copied["exposure_s"] == 0.02
    assert copied["scene"]["picture"] != one.state["settings"]["scene"]["picture"]
    assert Path(copied["scene"]["picture"]).read_bytes() == (tmp_path / "photo.png").read_bytes()
    assert two.state["settings"]["exposure_s"] == 0.02
    assert np.array_equal(again.code, codes_of({**one.state["settings"], "exposure_s": 0.03}))
    assert np.array_equal(two.code, codes_of({**copied, "seed": 8}))


def test_sessions_are_limited_and_freed(served, monkeypatch):
    monkeypatch.setattr(_server, "MAX_SESSIONS", 2)

    async def visit():
        pages = [await opened(served), await opened(served)]
        with pytest.raises(ConnectionClosed) as caught:
            await opened(served)
        await pages[0].connection.close()
        session = served.studio.sessions[pages[0].hello["session"]]
        await asyncio.to_thread(wait_until, lambda: session.is_idle)
        third = await opened(served)
        names = set(served.studio.sessions)
        for page in (*pages, third):
            await page.connection.close()
        return caught.value.rcvd.code, names, pages, third

    code, names, pages, third = run(visit())
    assert code == 4429
    assert names == {pages[1].hello["session"], third.hello["session"]}
    wait_until(lambda: all(session.is_idle for session in served.studio.sessions.values()))
    served.studio.free_idle(-1.0)
    assert served.studio.sessions == {}


def test_uploaded_picture_is_simulated(served, tmp_path):
    write_picture(tmp_path / "photo.png", np.full((20, 20, 3), 100, np.uint8))

    async def visit():
        page = await opened(served)
        session = page.hello["session"]
        status, _, body = await asyncio.to_thread(
            served.authorised, session, "/file?name=photo.png", (tmp_path / "photo.png").read_bytes()
        )
        await page.do(do="file", path=json.loads(body)["path"], **{"as": "scene"})
        _, headers, text = await asyncio.to_thread(served.authorised, session, "/download?what=yaml")
        await page.connection.close()
        return status, page, headers, text

    status, page, headers, text = run(visit())
    assert status == 200
    assert page.state["errors"] == {}
    assert yaml.safe_load(text)["scene"]["picture"] == "photo.png"
    assert headers["content-disposition"] == 'attachment; filename="small.yaml"'


def test_uploads_have_limits(served, monkeypatch):
    async def visit():
        page = await opened(served)
        await page.connection.close()
        return page.hello["session"]

    session = run(visit())
    monkeypatch.setattr(_server, "MAX_FILE_BYTES", 1000)
    assert served.authorised(session, "/file?name=a.png", b"x" * 1001)[0] == 413
    assert served.authorised(session, "/file?name=a.png", b"x" * 1000)[0] == 200
    served.studio.sessions[session].n_free_bytes = 500
    assert served.authorised(session, "/file?name=a.png", b"x" * 600)[0] == 413
    assert served.authorised(session, "/file?name=a.png", b"")[0] == 400
    assert served.authorised("other", "/file?name=a.png", b"x")[0] == 404
    assert served.get("/file?name=a.png", b"x")[0] == 403
    assert served.get("/download?what=yaml", Authorization="Bearer wrong")[0] == 403
    assert len(list(served.studio.sessions[session].uploads.iterdir())) == 1


def test_failed_downloads_give_one_line(served, monkeypatch):
    async def visit():
        page = await opened(served)
        answer = await asyncio.to_thread(served.authorised, page.hello["session"], "/download?what=gds")
        await page.connection.close()
        return answer

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_server, "write_layout", fail)
    status, _, content = run(visit())

    assert status == 400
    assert "No space left on device" in json.loads(content)["error"]


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("what", ["yaml", "python", "gds", "oas", "geojson", "npz", "svg", "png"])
def test_downloads_contain_current_state(served, what, tmp_path):
    async def visit():
        page = await opened(served)
        await page.do(do="set", key="layout.parameters.n_x", value=18, final=True)
        answer = await asyncio.to_thread(served.authorised, page.hello["session"], f"/download?what={what}")
        await page.connection.close()
        return answer

    status, headers, content = run(visit())
    path = tmp_path / headers["content-disposition"].split('"')[1]
    path.write_bytes(content)

    assert status == 200
    if what in ("gds", "oas", "geojson", "npz"):
        assert fs.read_layout(path).n_sites == 18 * 14
    else:
        assert len(content) > 200


def test_unknown_downloads_give_one_line(served):
    async def visit():
        page = await opened(served)
        await page.connection.close()
        return page.hello["session"]

    status, _, content = served.authorised(run(visit()), "/download?what=../x")
    assert status == 400
    assert "must be yaml, python" in json.loads(content)["error"]


def test_slow_connections_receive_newest_parts():
    async def fill():
        outbox = _server._Outbox(asyncio.get_running_loop())
        for k in range(5):
            outbox._put(b'\0\0\0\0{"part":"picture","version":%d}' % k)
            outbox._put(f"state {k}")
        return [message for _, message in outbox._messages]

    messages = asyncio.run(fill())
    assert [message for message in messages if isinstance(message, str)] == [f"state {k}" for k in range(5)]
    assert [message[-2:-1] for message in messages if isinstance(message, bytes)] == [b"4"]


def test_slow_connections_receive_parts_of_variant():
    """Newer parts do not replace those that precede the answer to freeze."""

    async def fill():
        outbox = _server._Outbox(asyncio.get_running_loop())
        for k in range(4):
            outbox._put(b'\0\0\0\0{"part":"columns","version":%d}' % k)
            outbox._put(json.dumps({"kind": "done", "id": k, "is_freeze": k == 1}))
        return [message for _, message in outbox._messages if isinstance(message, bytes)]

    assert [message[-2:-1] for message in asyncio.run(fill())] == [b"1", b"3"]


class Program:
    """The command in a process of its own."""

    def __init__(self, *arguments, temporary=None, n_lines=1):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "foveasim", "studio", "--no-browser", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(fs.__file__).parents[1],
            env=os.environ | ({"TMPDIR": str(temporary)} if temporary else {}),
        )  # fmt: skip
        lines = [self.process.stdout.readline() for _ in range(n_lines)]
        self.addresses = [line.split(" at ")[1].split()[0] for line in lines]
        self.host, _, token = self.addresses[0].removeprefix("http://").partition("/#")
        self.port = int(self.host.rpartition(":")[2])
        self.studio = type("Address", (), {"token": token})

    def stop(self, number):
        """Return exit code and standard error; the program ends also with an open page."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=TIMEOUT_S)
        return self.process.returncode, errors


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_delete_uploaded_files(name, tmp_path):
    """Also those of a session with an open page; the exit code is that of the signal."""
    number = getattr(signal, name, None)
    if number is None or signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("not on this system, or ignored as under nohup")
    program = Program(temporary=tmp_path)

    async def visit():
        page = await opened(program)
        request = urllib.request.Request(
            f"http://{program.host}/file?name=a.png",
            b"content",
            {"Authorization": f"Bearer {program.studio.token}", "X-Session": page.hello["session"]},
        )
        with await asyncio.to_thread(urllib.request.urlopen, request, timeout=TIMEOUT_S) as answer:
            path = Path(json.loads(answer.read())["path"])
        existed = await asyncio.to_thread(path.is_file) and path.is_relative_to(tmp_path)
        return existed, *await asyncio.to_thread(program.stop, number)

    existed, code, errors = run(visit())
    assert existed
    assert (code, errors) == (0 if name == "SIGINT" else 128 + number, "")
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.slow
def test_printed_addresses_answer():
    """At all addresses of this computer, with the address as host, and with no other one."""
    program = Program("--host", "0.0.0.0", n_lines=1 + len([each for each in other_addresses() if ":" not in each]))
    try:
        for address in program.addresses:
            with urllib.request.urlopen(address.partition("#")[0], timeout=TIMEOUT_S) as answer:
                assert answer.status == 200
            request = urllib.request.Request(address.partition("#")[0], headers={"Host": f"192.0.2.77:{program.port}"})
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(request, timeout=TIMEOUT_S)
    finally:
        _, errors = program.stop(signal.SIGTERM)
    assert len(errors.splitlines()) == 1  # the warning


def test_silent_connections_block_nobody(served):
    """The oldest ones are closed; a page with its token stays connected."""
    silent = []

    async def visit():
        page = await opened(served)
        silent.extend([socket.create_connection(("127.0.0.1", served.port), TIMEOUT_S) for _ in range(140)])
        status, _, _ = await asyncio.to_thread(served.get, "/")
        other = await opened(served)
        await page.do(do="set", key="seed", value=8, final=True)
        for each in (page, other):
            await each.connection.close()
        return status, page.state["settings"]["seed"]

    try:
        assert run(visit()) == (200, 8)
        silent[0].settimeout(TIMEOUT_S)
        try:
            closed = silent[0].recv(1) == b""
        except ConnectionResetError:
            closed = True
        assert closed
    finally:
        for each in silent:
            each.close()


@pytest.mark.slow
def test_restarted_server_restores_settings(tmp_path, settings):
    shot = tmp_path / "shot.yaml"
    shot.write_text(yaml.safe_dump(settings))

    async def before(program):
        page = await opened(program)
        await page.do(do="set", key="exposure_s", value=0.02, final=True)
        return page

    async def after(program, page):
        again = await opened(program, page.hello["session"])
        assert again.hello["is_new"]
        await again.do(do="restore", settings=page.state["settings"])
        return again, *await asyncio.to_thread(program.stop, signal.SIGINT)

    first = Program(str(shot))
    page = run(before(first))
    first.stop(signal.SIGKILL)
    again, code, errors = run(after(Program(str(shot)), page))

    assert again.state["settings"] == page.state["settings"]
    assert np.array_equal(again.code, page.code)
    assert (code, errors) == (0, "")
