"""Web server of the studio: page, socket, uploads and downloads, for this computer."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import secrets
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from foveasim import __version__
from foveasim._core.work_arrays import share_heap
from foveasim.errors import FoveasimError, ParameterError, SimulationError, printable
from foveasim.layout import write_layout
from foveasim.studio._exports import archive
from foveasim.studio._files import file_name, presets
from foveasim.studio._frames import camera_frame
from foveasim.studio._messages.encoding import is_answer_to_freeze, one_line
from foveasim.studio._session import MAX_SESSION_BYTES, Session, Start
from foveasim.studio._start import contents_of

#: Largest uploaded file.
MAX_FILE_BYTES = 64 << 20
#: Largest message of a page.
MAX_MESSAGE_BYTES = 1 << 20
#: Time after which sessions without a page are closed, and their number.
IDLE_S, MAX_SESSIONS = 1800.0, 8
#: Time limit for the first message of a connection.
HELLO_S = 10.0
#: Simultaneous connections; further ones receive 503.
MAX_CONNECTIONS = 256
#: Simultaneous connections that have not sent the token; the oldest ones are closed.
MAX_UNAUTHENTICATED = 64
#: Largest number of messages that wait for a slow connection.
MAX_OUTGOING = 1000
#: Longest time that a simulation delays the thread that sends messages.
SWITCH_INTERVAL_S = 5e-4
#: Close code for a wrong token.
WRONG_TOKEN = 4403
TOO_MANY = 4429
#: Addresses that stand for all addresses of this computer.
UNSPECIFIED = ("0.0.0.0", "::")  # noqa: S104 -- compared, not bound
HTTP_PORT = 80
#: Texts that can be downloaded, and their extensions.
TEXTS = {"yaml": "yaml", "python": "py", "notebook": "ipynb"}
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".webp": "image/webp",
}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), display-capture=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Studio:
    """
    Sessions and their web application.

    Parameters
    ----------
    start : Start
    token : str, optional
        Secret of the address; random by default.
    hosts : set of str
        Values of the header ``Host`` that are accepted.
    has_all_addresses : bool
        Whether the server listens at all addresses of this computer: ``Host`` may be the one of the connection.
    """

    def __init__(
        self, start: Start, *, token: str | None = None, hosts: set[str], has_all_addresses: bool = False
    ) -> None:
        self.start, self.hosts = start, hosts
        self.token = token or secrets.token_urlsafe(24)
        self.sessions: dict[str, Session] = {}
        self._opening = threading.Lock()  # in threads, because files are copied
        self.unauthenticated = _Unauthenticated()
        routes = [
            Route("/", self._index),
            Route("/static/{name}", self._static),
            Route("/static/views/{name}", self._view),
            Route("/static/presets/{name}", self._thumbnail),
            Route("/web/{name}", self._web),
            Route("/file", self._file, methods=["POST"]),
            Route("/download", self._download),
            Route("/start", self._start_page),
            WebSocketRoute("/socket", self._socket),
        ]
        self.app: ASGIApp = _Guard(Starlette(routes=routes), hosts, has_all_addresses=has_all_addresses)

    def close(self) -> None:
        """Close all sessions."""
        for session in self.sessions.values():
            session.close()
        self.sessions.clear()

    def session(
        self, name: object, page: object = None, outgoing: _Outbox | None = None
    ) -> tuple[Session | None, bool]:
        """
        Return the session of a name or a new one, and whether it has the initial state.

        ``page``: identifier of the page. If another page uses the session, such as the one that a tab was duplicated from, the
        new session has a copy of its state. ``outgoing``: receives the messages of the session.
        """
        with self._opening:
            session, is_new = self._session(name, page if isinstance(page, str) else None)
            if session is not None and outgoing is not None:
                session.attach(outgoing.put, answers=True)  # at once: a session without a page may be closed
        return session, is_new

    def _session(self, name: object, page: str | None) -> tuple[Session | None, bool]:
        origin = self.sessions.get(name) if isinstance(name, str) else None
        if origin is not None and (origin.is_idle or origin.page == page):
            origin.page = page
            return origin, False
        self.free_idle()
        if len(self.sessions) >= MAX_SESSIONS:
            # A page that was closed leaves its session; the oldest one makes space.
            idle = [each for each in self.sessions.values() if each.is_idle]
            if not idle:
                return None, True
            oldest = min(idle, key=lambda each: each.queue.last_used_s)
            self.sessions.pop(oldest.name).close()
        session = Session(secrets.token_urlsafe(12), self.start, origin=origin)
        session.page = page
        self.sessions[session.name] = session
        return session, origin is None

    def free_idle(self, idle_s: float = IDLE_S) -> None:
        """Close sessions without a page."""
        now_s = time.monotonic()
        for name, session in list(self.sessions.items()):
            if session.is_idle and now_s - session.queue.last_used_s > idle_s:
                self.sessions.pop(name).close()

    async def free_idle_sessions(self) -> None:
        """Close sessions without a page, from time to time, until cancelled."""
        while True:
            await asyncio.sleep(IDLE_S / 10.0)
            self.free_idle()

    # -- pages ------------------------------------------------------------------------------------------------------

    async def _index(self, _request: Request) -> Response:
        return _package_file("foveasim.studio", "static", "index.html")

    async def _static(self, request: Request) -> Response:
        return _package_file("foveasim.studio", "static", request.path_params["name"])

    async def _view(self, request: Request) -> Response:
        return _package_file("foveasim.studio", "static/views", request.path_params["name"])

    async def _thumbnail(self, request: Request) -> Response:
        return _package_file("foveasim.studio", "static/presets", request.path_params["name"])

    async def _web(self, request: Request) -> Response:
        name = request.path_params["name"]
        return _package_file("foveasim.view", "web", name if name.endswith(".js") else "")

    # -- socket -----------------------------------------------------------------------------------------------------

    async def _socket(self, socket: WebSocket) -> None:
        await socket.accept()
        outgoing: _Outbox | None = None
        session: Session | None = None
        sender: asyncio.Task[None] | None = None
        try:
            async with asyncio.timeout(HELLO_S):
                first = _parse(await socket.receive_text())
            if not isinstance(first, dict) or not self._is_token(first.get("token")):
                await socket.close(WRONG_TOKEN, "wrong token")
                return
            self.unauthenticated.remove(socket.client)
            outgoing = _Outbox(asyncio.get_running_loop())
            session, is_new = await asyncio.to_thread(self.session, first.get("session"), first.get("page"), outgoing)
            if session is None:
                await socket.close(TOO_MANY, "too many sessions")
                return
            hello = {
                "kind": "hello",
                "session": session.name,
                "version": __version__,
                "is_new": is_new,
                "presets": presets(),
            }
            await socket.send_text(json.dumps({**hello, **session.hello()}))
            sender = asyncio.create_task(outgoing.send_to(socket))
            while True:
                session.post(_message(await socket.receive()))
        except (WebSocketDisconnect, TimeoutError, KeyError, RuntimeError):
            pass  # disconnected, silent, or a first message in binary
        finally:
            self.unauthenticated.remove(socket.client)
            if session is not None and outgoing is not None:
                session.detach(outgoing.put)
            if sender is not None:
                sender.cancel()
                with contextlib.suppress(asyncio.CancelledError, Exception):
                    await sender
            if socket.client_state is WebSocketState.CONNECTED and socket.application_state is WebSocketState.CONNECTED:
                with contextlib.suppress(RuntimeError):
                    await socket.close()

    def _is_token(self, token: object) -> bool:
        return isinstance(token, str) and hmac.compare_digest(token.encode(errors="replace"), self.token.encode())

    # -- files ------------------------------------------------------------------------------------------------------

    def _authorised(self, request: Request) -> Session | Response:
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer" or not self._is_token(token.strip()):
            return _error("wrong token", 403)
        self.unauthenticated.remove(request.client)
        session = self.sessions.get(request.headers.get("x-session", ""))
        return _error("unknown session; reload the page", 404) if session is None else session

    async def _file(self, request: Request) -> Response:
        session = self._authorised(request)
        if isinstance(session, Response):
            return session
        limit = min(MAX_FILE_BYTES, session.n_free_bytes)
        message = (
            f"files may have at most {MAX_FILE_BYTES >> 20} MiB, and those of a session {MAX_SESSION_BYTES >> 20} MiB"
        )
        length = request.headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > limit:
            return _error(message, 413)
        content = bytearray()
        async for piece in request.stream():
            content += piece
            if len(content) > limit:
                return _error(message, 413)
        if not content:
            return _error("the file is empty", 400)
        try:
            path = await asyncio.to_thread(session.add_file, request.query_params.get("name", "file"), bytes(content))
        except OSError as error:
            return _error(f"the file cannot be stored: {error.strerror or error}", 400)
        if path is None:
            return _error(message, 413)
        return JSONResponse({"path": str(path), "name": path.name})

    async def _start_page(self, request: Request) -> Response:
        session = self._authorised(request)
        if isinstance(session, Response):
            return session
        return JSONResponse(await asyncio.to_thread(contents_of, session.files))

    async def _download(self, request: Request) -> Response:
        session = self._authorised(request)
        if isinstance(session, Response):
            return session
        what = request.query_params.get("what", "")
        try:
            content, name = await asyncio.to_thread(_exported, session, what)
        except FoveasimError as error:
            return _error(" ".join(printable(str(error)).split()), 400)
        except (OSError, MemoryError) as error:
            return _error(f"the file cannot be written: {one_line(error)}", 400)
        plain = name.encode("ascii", "replace").decode().replace("?", "_")
        disposition = f'attachment; filename="{plain}"' + ("" if plain == name else f"; filename*=UTF-8''{quote(name)}")
        return Response(content, media_type="application/octet-stream", headers={"Content-Disposition": disposition})


class _Unauthenticated:
    """
    Connections that have not sent the token, from the oldest.

    Beyond :data:`MAX_UNAUTHENTICATED` the oldest ones are closed, so that silent connections do not block others.
    """

    def __init__(self) -> None:
        self._transports: dict[tuple[str, int], asyncio.Transport] = {}

    def add(self, transport: asyncio.Transport) -> None:
        """Add a new connection."""
        peer = transport.get_extra_info("peername")
        if not isinstance(peer, tuple):
            return
        self._transports[str(peer[0]), int(peer[1])] = transport
        while len(self._transports) > MAX_UNAUTHENTICATED:
            self._transports.pop(next(iter(self._transports))).abort()

    def remove(self, client: Any) -> None:
        """Remove a connection that is closed, or has sent the token, by its address and port."""
        if client is not None:
            self._transports.pop((str(client[0]), int(client[1])), None)


class _Outbox:
    """
    Messages that wait for a connection; newer parts replace older ones of the same view.

    Parts before the answer to ``freeze`` are those of the variant, which the page keeps.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._messages: deque[tuple[str | None, str | bytes]] = deque()
        self._is_ready = asyncio.Event()

    def put(self, message: str | bytes) -> None:
        """Add a message; called from any thread."""
        self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: str | bytes) -> None:
        name = _part_name(message) if isinstance(message, bytes) else None
        if isinstance(message, str) and is_answer_to_freeze(message):
            self._messages = deque((None, earlier) for _, earlier in self._messages)
        if name is not None:
            self._messages = deque(item for item in self._messages if item[0] != name)
        if len(self._messages) < MAX_OUTGOING:
            self._messages.append((name, message))
        self._is_ready.set()

    async def send_to(self, connection: WebSocket) -> None:
        """Send messages until the connection is closed."""
        while True:
            await self._is_ready.wait()
            while self._messages:
                _, message = self._messages.popleft()
                if isinstance(message, bytes):
                    await connection.send_bytes(message)
                else:
                    await connection.send_text(message)
            self._is_ready.clear()


def _part_name(message: bytes) -> str:
    start = message.index(b'"part":"') + 8
    return message[start : message.index(b'"', start)].decode()


class _Guard:
    """Check of the headers ``Host`` and ``Origin``, and headers of all responses."""

    def __init__(self, app: ASGIApp, hosts: set[str], *, has_all_addresses: bool) -> None:
        self.app, self.hosts, self.has_all_addresses = app, hosts, has_all_addresses

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        hosts = [value.decode("latin-1").lower() for name, value in scope["headers"] if name == b"host"]
        origins = [value.decode("latin-1").lower() for name, value in scope["headers"] if name == b"origin"]
        allowed = self.hosts
        if self.has_all_addresses and scope.get("server"):  # of the interface that the connection came through
            address, port = scope["server"]
            address = address.removeprefix("::ffff:")  # IPv4 of a socket for both
            allowed = allowed | _with_port({in_address(address)}, port)
        if (
            len(hosts) != 1
            or hosts[0] not in allowed
            or any(origin not in {f"http://{host}" for host in allowed} for origin in origins)
        ):
            if scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close", "code": WRONG_TOKEN})
            else:
                await _error("wrong host or origin", 403)(scope, receive, send)
            return

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                present = {name.lower() for name, _ in message["headers"]}
                added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *(item for item in added if item[0] not in present)]
            await send(message)

        await self.app(scope, receive, send_with_headers)


def _error(text: str, status: int) -> Response:
    return JSONResponse({"error": text}, status, headers=HEADERS)


def _message(received: Any) -> Any:
    """
    Return a message of a page: JSON, or a camera frame in binary; None if it is invalid.

    Raises WebSocketDisconnect when the page has closed the connection.
    """
    if received["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(received.get("code", 1000))
    if received.get("text") is not None:
        return _parse(received["text"])
    try:
        return camera_frame(received["bytes"])
    except ParameterError:
        return None


def _parse(text: str) -> Any:
    """Return the JSON value of a message; None if it is invalid."""
    try:
        return json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        return None


def _reject_constant(name: str) -> None:
    raise ValueError(name)


def _package_file(package: str, directory: str, name: str) -> Response:
    """Return a file of the package; names contain no directories."""
    path = files(package) / directory / name
    kind = TYPES.get(Path(name).suffix)
    if not name or kind is None or "/" in name or "\\" in name or name.startswith(".") or not path.is_file():
        return PlainTextResponse("not found\n", 404)
    return Response(path.read_bytes(), media_type=kind)


def _exported(session: Session, what: str) -> tuple[bytes, str]:
    """Return the content and the name of a file of the current state."""
    stem = file_name(session.start.name)
    if what in TEXTS:
        return session.text(what).encode(), f"{stem}.{TEXTS[what]}"
    if what == "zip":
        exported, result = session.exported(), session.result
        texts = {f"{stem}.{extension}": session.text(text, exported) for text, extension in TEXTS.items()}
        return archive(stem, texts, exported[1], None if result is None else result.capture.layout), f"{stem}.zip"
    if what not in ("gds", "oas", "geojson", "npz", "svg", "png", "csv"):
        names = f"{', '.join(TEXTS)}, zip, gds, oas, geojson, npz, svg, png or csv"
        raise ParameterError("what", f"must be {names}", printable(what)[:40])
    if session.result is None:
        raise SimulationError("there is no result")
    capture = session.result.capture
    with tempfile.TemporaryDirectory(prefix="foveasim-studio-") as directory:
        path = Path(directory) / f"{stem}.{what}"
        if what == "png":
            capture.picture(max_pixels=1024).save(path, capture.white_dn)
        elif what == "csv":
            session.gaze.required_path(session.history.settings).write(path)
        else:
            write_layout(capture.layout, path)
        return path.read_bytes(), path.name


def host_names(host: str, port: int) -> set[str]:
    """Return the accepted values of the header ``Host``."""
    names = {"127.0.0.1", "localhost", "[::1]", in_address(host)}
    if host in UNSPECIFIED:
        names |= {socket.gethostname(), *(in_address(address) for address in other_addresses())}
    return _with_port(names, port)


def _with_port(names: set[str], port: int) -> set[str]:
    """Return values of the header ``Host``."""
    lower = {name.lower() for name in names}
    return {f"{name}:{port}" for name in lower} | (lower if port == HTTP_PORT else set())


def in_address(host: str) -> str:
    """Return a host as in a URL."""
    return f"[{host}]" if ":" in host else host


def other_addresses() -> list[str]:
    """Return addresses of this computer for others: of its routes, and of its name."""
    found: list[str] = []
    for family, remote in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        # For datagrams, connecting selects an interface and sends nothing; both addresses are reserved for documentation.
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((remote, 9))
            found.append(str(probe.getsockname()[0]))
    with contextlib.suppress(OSError):
        found += [str(each[4][0]) for each in socket.getaddrinfo(socket.gethostname(), None)]
    return [each for each in dict.fromkeys(found) if not ipaddress.ip_address(each.partition("%")[0]).is_loopback]


def serve(
    studio: Studio,
    listener: socket.socket,
    announce: Callable[[], None],
    started: Callable[[Any], object] | None = None,
) -> None:
    """
    Serve the studio until Ctrl-C, SIGTERM or SIGHUP.

    All sessions are then closed, and uploaded files deleted.

    ``listener``: bound to the address. ``announce``: called when the server accepts requests. ``started``: called with the
    server, whose ``should_exit`` stops it, before it runs.
    """
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Protocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            studio.unauthenticated.add(transport)

        def connection_lost(self, exc: Exception | None) -> None:
            studio.unauthenticated.remove(self.client)
            super().connection_lost(exc)

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=sockets)
            self.idle = asyncio.create_task(studio.free_idle_sessions())
            announce()

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            self.idle.cancel()
            await super().shutdown(sockets=sockets)

    config = uvicorn.Config(
        studio.app,
        log_level="critical",
        access_log=False,
        lifespan="off",
        http=Protocol,
        ws="websockets-sansio",
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # costs more time than the transfer on this computer
        timeout_graceful_shutdown=0,
        limit_concurrency=MAX_CONNECTIONS,
        proxy_headers=False,
        server_header=False,
        date_header=False,
    )
    # Connections inherit it: otherwise a short message after a large one waits for an acknowledgement, about 40 ms.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    share_heap()
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        server = Server(config)
        if started is not None:
            started(server)
        with contextlib.suppress(KeyboardInterrupt), _ended_by_signals(server):
            server.run(sockets=[listener])
    finally:
        sys.setswitchinterval(interval_s)
        studio.close()


@contextlib.contextmanager
def _ended_by_signals(server: Any) -> Iterator[None]:
    """
    Let SIGTERM and SIGHUP stop a server, and then raise SystemExit.

    Signals that are ignored remain so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _frame: Any) -> None:
        # The server handles SIGTERM itself, and raises it again when it has stopped.
        if server.should_exit or not server.started:
            raise SystemExit(128 + number)
        received.append(number)
        server.should_exit = True

    received: list[int] = []
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    changed = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
    for number in changed:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)
    if received:
        raise SystemExit(128 + received[0])
