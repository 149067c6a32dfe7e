"""
Studio: an interactive design table in the browser.

Every setting of a shot is a control; scene, photosites, picture, noise and design rules are updated while it changes.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from foveasim._core.calls import PORT, publish
from foveasim._core.extras import import_optional
from foveasim.config import check_directory
from foveasim.errors import FileError, FoveasimWarning, ParameterError, warn

__all__ = ["run_studio"]

#: Modules of the extra.
MODULES = ("starlette", "uvicorn", "websockets")
#: Commands of browsers that show text in the terminal.
TEXT_BROWSERS = ("www-browser", "links", "elinks", "lynx", "w3m")
#: Environment variable with the token of the address, and its minimum length.
TOKEN_VARIABLE, MIN_TOKEN_LENGTH = "FOVEASIM_STUDIO_TOKEN", 24


def run_studio(
    shot: str | Path | None = None,
    *,
    changes: Sequence[str] = (),
    out: str | Path | None = None,
    host: str = "127.0.0.1",
    port: Annotated[int, PORT] = 0,
    open_browser: bool = True,
    announce: Callable[[str, bool], None] | None = None,
) -> None:
    """
    Open the studio in a browser until Ctrl-C.

    Parameters
    ----------
    shot : path, optional
        Settings file to start from; by default that of the demo, below a start page if there are no changes.
    changes : sequence of "key=value"
        Settings to replace, as for :func:`foveasim.config.read_shot`.
    out : path, optional
        Directory for saved files. Without it, the studio writes no files.
    host : str
        Address of this computer. Others than ``127.0.0.1`` make the studio accessible from other computers.
    port : int
        0 for any free port.
    open_browser : bool
        Whether to open a browser.
    announce : function of (address, whether a browser opens it), optional
        Called for each address when the server accepts requests; by default the addresses are printed.

    Raises
    ------
    ConfigError
        When the settings file cannot be read, or is invalid.
    ParameterError
        When the extra ``studio`` is not installed, the port is out of range or in use, the host is not an address of this
        computer, or the token of the environment is too short.
    FileError
        When the directory for saved files cannot be created or written.

    Warns
    -----
    FoveasimWarning
        When the host is not a loopback address.

    Notes
    -----
    The address contains a random token. Browsers are started with a file that leads to it, which only the user can read: other
    users can see the arguments of commands. The environment variable ``FOVEASIM_STUDIO_TOKEN`` specifies another token, so
    that the address is the same after a restart.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.studio.run_studio(
    ...     "shot.yaml", changes=["sensor.bits=10"], out="saved"
    ... )  # doctest: +SKIP
    """
    for module in MODULES:
        import_optional("studio", module)
    from foveasim.config import check_settings
    from foveasim.studio._files import start_settings
    from foveasim.studio._server import UNSPECIFIED, Studio, host_names, in_address, other_addresses, serve
    from foveasim.studio._session import Start

    if not host:  # a socket would listen at all addresses
        raise ParameterError("host", "must be an address of this computer", host)
    token = _own_token()
    directory = None if out is None else _writable(out)
    settings, name = start_settings(shot, changes)
    check_settings(None if shot is None else Path(shot), settings)
    start = Start(
        settings,
        name,
        None if shot is None else Path(shot).absolute().parent,
        directory,
        shows_start_page=shot is None and not changes,
    )
    if not _is_loopback(host):
        warn(
            f"the studio is accessible from other computers at {host}: everyone with the address and its token can use it; "
            "the connection is not encrypted",
            FoveasimWarning,
        )
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        has_both = host == "::" and socket.has_dualstack_ipv6()
        listener = socket.create_server((host, port), family=family, dualstack_ipv6=has_both)
    except OSError as error:
        if error.errno in (errno.EADDRNOTAVAIL, socket.EAI_NONAME, socket.EAI_AGAIN):
            raise ParameterError("host", "must be an address of this computer", host) from None
        raise ParameterError("port", f"must be a free port ({error.strerror or error})", port) from None
    with listener:
        found = int(listener.getsockname()[1])
        is_everywhere = host in UNSPECIFIED
        studio = Studio(start, token=token, hosts=host_names(host, found), has_all_addresses=is_everywhere)
        first = host if not is_everywhere else "127.0.0.1" if has_both or ":" not in host else "::1"
        others = (
            [each for each in other_addresses() if has_both or (":" in each) == (":" in host)] if is_everywhere else []
        )
        addresses = [f"http://{in_address(each)}:{found}/#{studio.token}" for each in (first, *others)]
        browser = _graphical_browser() if open_browser else None

        def ready() -> None:
            for address in addresses:
                if announce is not None:
                    announce(address, browser is not None)
                else:
                    sys.stdout.write(f"{address}\n")
                    sys.stdout.flush()
            if browser is not None:
                # In a thread: some commands return only when the browser is closed.
                threading.Thread(target=browser.open, args=(page.as_uri(),), name="studio browser", daemon=True).start()

        with tempfile.TemporaryDirectory(prefix="foveasim-studio-") as folder:
            page = _redirection(Path(folder), addresses[0])
            serve(studio, listener, ready)


def _graphical_browser() -> webbrowser.BaseBrowser | None:
    """Return the browser of the user, None without one that shows pages with scripts."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return None
    return None if browser.name in TEXT_BROWSERS else browser


def _redirection(folder: Path, address: str) -> Path:
    """Write a page that leads to an address, which only the user can read."""
    path = folder / "studio.html"
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(
            f'<!doctype html><meta charset="utf-8"><title>foveasim studio</title>'
            f'<meta http-equiv="refresh" content="0; url={address}"><a href="{address}">foveasim studio</a>\n'
        )
    return path


def _own_token() -> str | None:
    """Return the token of the environment, None without one; it is not repeated in messages."""
    token = os.environ.get(TOKEN_VARIABLE)
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{MIN_TOKEN_LENGTH},}}", token):
        raise ParameterError(
            TOKEN_VARIABLE, f"must have at least {MIN_TOKEN_LENGTH} characters of A-Z, a-z, 0-9, '-', '_'"
        )
    return token


def _writable(out: str | Path) -> Path:
    """Create the directory for saved files, check that it can be written, and return it."""
    directory = check_directory(out)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise FileError(directory, f"cannot be written: {error.strerror or error}") from None
    return directory


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


publish(__name__)
