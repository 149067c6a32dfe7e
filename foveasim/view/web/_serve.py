"""Local server of a page, which other computers cannot reach."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

from foveasim._core.calls import PORT
from foveasim.errors import ParameterError

#: Loopback address: other computers cannot reach it.
HOST = "127.0.0.1"
#: Time limit of a connection for its request, and for each piece of the page.
TIMEOUT_S = 10.0
#: Time limit of a connection for closing.
CLOSE_TIMEOUT_S = 1.0
#: Simultaneous connections; further ones receive 503 (service unavailable). A browser opens six.
MAX_CONNECTIONS = 128
#: Largest request; those of browsers have a few hundred bytes.
MAX_REQUEST_BYTES = 16_384
#: Size of the pieces in which the page is sent, which limits the memory of slow connections.
PIECE_BYTES = 65_536


def serve_page(page: str, *, port: Annotated[int, PORT] = 0, announce: Callable[[str], None]) -> None:
    """
    Serve one page on localhost until the user stops it with Ctrl-C.

    Parameters
    ----------
    page : str
        From :func:`foveasim.view.web_page`.
    port : int
        0 for any free port.
    announce : function
        Called with the address when the server accepts requests.

    Raises
    ------
    ParameterError
        When the port is out of range or in use.

    Notes
    -----
    Answers GET and HEAD of ``/``, one request per connection, in one thread. Requests with a ``Host`` other than this computer
    are rejected, which prevents DNS rebinding by other sites.
    """
    try:
        listener = socket.create_server((HOST, port), backlog=MAX_CONNECTIONS)
    except OSError as error:
        raise ParameterError("port", f"must be a free port ({error.strerror or error})", port) from None
    with listener, contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(listener, page.encode(), announce))


async def _serve(listener: socket.socket, content: bytes, announce: Callable[[str], None]) -> None:
    port = listener.getsockname()[1]
    names = {f"{name}:{port}" for name in (HOST, "localhost")} | ({HOST, "localhost"} if port == 80 else set())
    n_open = 0

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal n_open
        n_open += 1
        try:
            if n_open <= MAX_CONNECTIONS:
                await _answer(reader, writer, names, content)
            elif n_open <= 2 * MAX_CONNECTIONS:
                await _send(writer, HTTPStatus.SERVICE_UNAVAILABLE)
            await _close(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            # Disconnected, timed out (TimeoutError is an OSError), or the server stops: no response is possible.
            writer.transport.abort()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()  # retrieves the error of the connection, which asyncio would print
        finally:
            n_open -= 1

    await asyncio.start_server(handle, sock=listener, limit=MAX_REQUEST_BYTES)
    announce(f"http://{HOST}:{port}/")
    await asyncio.Event().wait()


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, names: set[str], content: bytes) -> None:
    """Read one request and answer it."""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        await _send(writer, HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
        return
    first, *lines = head.decode("latin-1").split("\r\n")[:-2]
    words = first.split(" ")
    fields = [line.partition(":") for line in lines]
    hosts = [value.strip().lower() for name, _, value in fields if name.lower() == "host"]
    if len(words) != 3 or not words[2].startswith("HTTP/1.") or len(hosts) != 1:
        await _send(writer, HTTPStatus.BAD_REQUEST)
    elif hosts[0] not in names:
        await _send(writer, HTTPStatus.FORBIDDEN)
    elif words[0] not in ("GET", "HEAD"):
        await _send(writer, HTTPStatus.METHOD_NOT_ALLOWED)
    elif words[1].partition("?")[0] != "/":
        await _send(writer, HTTPStatus.NOT_FOUND)
    else:
        await _send(writer, HTTPStatus.OK, content, with_content=words[0] == "GET")


async def _send(
    writer: asyncio.StreamWriter, status: HTTPStatus, content: bytes | None = None, *, with_content: bool = True
) -> None:
    """Send a response; without content, the status as plain text."""
    is_page = content is not None
    body = f"{status.value} {status.phrase}\n".encode() if content is None else content
    head = [
        f"HTTP/1.1 {status.value} {status.phrase}",
        f"Content-Type: text/{'html' if is_page else 'plain'}; charset=utf-8",
        f"Content-Length: {len(body)}",
        "Cache-Control: no-store",
        "Connection: close",
        # Other sites must neither frame nor embed this page, and browsers must not guess its type.
        "Content-Security-Policy: frame-ancestors 'none'",
        "Cross-Origin-Resource-Policy: same-origin",
        "X-Content-Type-Options: nosniff",
        *(["Allow: GET, HEAD"] if status is HTTPStatus.METHOD_NOT_ALLOWED else []),
    ]
    writer.write("\r\n".join((*head, "", "")).encode("latin-1"))
    pieces = range(0, len(body), PIECE_BYTES) if with_content else ()
    for start in pieces:
        writer.write(body[start : start + PIECE_BYTES])
        async with asyncio.timeout(TIMEOUT_S):
            await writer.drain()


async def _close(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """
    Close the connection after the client has read the response.

    Closing with unread request data resets the connection, and the client loses the response.
    """
    writer.write_eof()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(min(CLOSE_TIMEOUT_S, TIMEOUT_S)):
            while await reader.read(PIECE_BYTES):
                pass
    writer.close()


def open_page(page: str) -> tuple[Path, bool]:
    """
    Write a page to a temporary file and open it in the browser.

    Returns
    -------
    path : Path
        Path of the file, which is not deleted.
    is_opened : bool
        Whether a browser was found.
    """
    import tempfile
    import webbrowser

    path = Path(tempfile.mkdtemp(prefix="foveasim-")) / "view.html"
    path.write_text(page, encoding="utf-8")
    return path, webbrowser.open(path.as_uri())
