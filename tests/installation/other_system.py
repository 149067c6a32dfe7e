"""
Imitation of a system without the calls of POSIX, such as Windows, on Linux.

Each process of an environment of ``installation.environments.make_imitation`` imports this module first. The package can then
import neither ``fcntl`` nor ``resource``, but ``msvcrt`` with locks of single bytes; files that are open can be neither removed
nor replaced, nor can directories that contain them be renamed; there is one core and one start method of processes.
"""

from __future__ import annotations

import builtins
import errno
import fcntl
import multiprocessing
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

MISSING_MODULES = {"fcntl", "resource"}
MISSING = {
    os: ("fork", "killpg", "preadv", "register_at_fork", "sched_getaffinity"),
    signal: ("SIGHUP", "SIGXCPU", "pthread_sigmask"),
}
import_module = builtins.__import__


def locking(fd, mode, n_bytes):
    """Lock bytes from the present position; those that another process has locked raise an error."""
    try:
        fcntl.lockf(fd, fcntl.LOCK_EX | fcntl.LOCK_NB, n_bytes, 0, os.SEEK_CUR)
    except OSError:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES)) from None


MSVCRT = SimpleNamespace(LK_NBLCK=2, locking=locking)


def import_for_package(name, importer=None, *rest, **options):
    """Import a module; for the package, those of Windows instead of those of POSIX."""
    about = importer or {}
    importing = about.get("__package__") or Path(about.get("__file__") or "").name
    if importing.startswith(("foveasim", "_sandboxed")):
        if name in MISSING_MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name == "msvcrt":
            return MSVCRT
    return import_module(name, importer, *rest, **options)


def absolute(path, fd=None):
    """Return the absolute path of a file, or of one in an open directory."""
    folder = Path.cwd() if fd is None else Path(f"/proc/self/fd/{fd}").readlink()
    return Path(os.path.normpath(folder / os.fsdecode(path)))


def open_files():
    """Yield the paths of the files that this process has open."""
    for fd in list(Path("/proc/self/fd").iterdir()):
        with suppress(OSError):  # that of the listed directory is closed
            path = fd.readlink()
            if path.is_file():
                yield path


def refuse_open_files(call, *keys):
    """Return a call of the system that refuses paths of open files; ``keys``: names of the open directories of its paths."""

    def checked(*paths, **options):
        named = [absolute(path, options.get(key)) for path, key in zip(paths, keys, strict=False)]
        for path in open_files():
            if any(path.is_relative_to(name) for name in named):
                raise PermissionError(
                    errno.EACCES, "The process cannot access the file because it is being used", str(path)
                )
        return call(*paths, **options)

    return checked


def imitate():
    """Change the modules of this process."""
    builtins.__import__ = import_for_package
    for module, names in MISSING.items():
        for name in names:
            delattr(module, name)
    os.cpu_count = os.process_cpu_count = lambda: 1  # the second from Python 3.13
    multiprocessing.get_all_start_methods = lambda: ["spawn"]
    for name in ("remove", "unlink", "rmdir"):
        setattr(os, name, refuse_open_files(getattr(os, name), "dir_fd"))
    for name in ("rename", "replace"):
        setattr(os, name, refuse_open_files(getattr(os, name), "src_dir_fd", "dst_dir_fd"))


if "foveasim" not in sys.modules:
    imitate()
