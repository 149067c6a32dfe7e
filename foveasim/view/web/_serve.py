"""A page handed out on this computer, to its own browser and to nobody else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from foveasim.arrays import check_count
from foveasim.errors import ParameterError

__all__ = ["open_page", "serve_page"]

#: The only address that is listened on: no other computer reaches it.
HOST = "127.0.0.1"


def serve_page(text: str, *, port: int = 0, tell: Callable[[str], None]) -> None:
    """
    Hand out one page until the user stops it with Ctrl-C.

    Parameters
    ----------
    text : str
        From :func:`foveasim.view.web_page`.
    port : int
        0 for any that is free.
    tell : function
        Is called with the address, once it can be asked.

    Raises
    ------
    ParameterError
        When the port is none, or taken.
    """
    from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

    port = check_count("port", port, at_least=0, at_most=2**16 - 1)
    content = text.encode()

    class Handler(BaseHTTPRequestHandler):
        """Answers with the page, and to nothing else."""

        def do_GET(self) -> None:
            self._answer(with_content=True)

        def do_HEAD(self) -> None:
            self._answer(with_content=False)

        def _answer(self, *, with_content: bool) -> None:
            # A name that a stranger's site gave this address is refused, so that no other site can read the page.
            is_ours = self.headers.get("Host") in {f"{name}:{self.server.server_port}" for name in (HOST, "localhost")}  # type: ignore[attr-defined]
            if not is_ours or self.path.partition("?")[0] != "/":
                self.send_error(404 if is_ours else 403)
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if with_content:
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 -- the name is the library's
            """Say nothing: the user asked for a page, not for a log."""

    try:
        server = ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise ParameterError("port", f"cannot be listened on ({error.strerror or error})", port) from None
    with server:
        tell(f"http://{HOST}:{server.server_port}/")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return


def open_page(text: str) -> tuple[Path, bool]:
    """
    Write a page to a temporary file and open it in the browser.

    Returns
    -------
    path : Path
        Of the file, which stays.
    is_opened : bool
        Whether there was a browser.
    """
    import tempfile
    import webbrowser

    path = Path(tempfile.mkdtemp(prefix="foveasim-")) / "view.html"
    path.write_text(text, encoding="utf-8")
    return path, webbrowser.open(path.as_uri())
