"""Files and folders written whole or not at all, and locks on them."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from foveasim.errors import FileError, disk_problem

__all__ = ["atomic_directory", "atomic_write", "check_room", "lock", "remove_folder"]

#: A disk with less space than a block is full.
FULL_DISK_BYTES = 4096
#: A folder is removed once more after each of these times.
RETRY_S = (0.0, 0.05, 0.25)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """
    A temporary name in the target's folder, renamed to the target when the block ends well, removed otherwise.

    The temporary name keeps the target's ending, by which libraries choose a format.

    Raises
    ------
    FileError
        When the folder does not exist, or writing fails: the disk is full, say, whatever a library makes of that.
    """
    target = Path(path)
    temporary = target.with_name(f".foveasim-{secrets.token_hex(8)}{target.suffix}")
    try:
        if not target.parent.is_dir():
            raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
        if target.is_dir():
            raise FileError(target, "cannot be written: it is a folder")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        if reason := _full(temporary):  # some libraries do not notice, and leave half a file
            raise FileError(target, f"cannot be written: {reason}")
        temporary.replace(target)
    except Exception as error:
        _raise_reason(error, target, temporary)
        raise
    finally:
        with suppress(OSError):  # a name too long for the system was never made
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(target: Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """
    A temporary folder, renamed to the target when the block ends well, removed otherwise.

    Raises
    ------
    FileError
        When something is there that is not ours, the folder around it does not exist, or writing fails.
    """
    token = secrets.token_hex(8)
    new, old = (target.with_name(f".foveasim-{token}-{which}{target.suffix}") for which in ("new", "old"))
    try:
        if target.exists() and not is_ours(target):
            raise FileError(target, "cannot be written: something else is there")
        if not target.parent.is_dir():
            raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    except Exception as error:
        with suppress(OSError):  # no permission for the folder
            if old.exists() and not target.exists():
                old.rename(target)
        _raise_reason(error, target, new)
        raise
    finally:
        for folder in (new, old):
            remove_folder(folder)


def remove_folder(folder: Path) -> None:
    """
    Remove a folder with its contents, if it exists; ignore what the system does not let us remove.

    The threads of zarr may still write for a moment after an error, and create the folder again.
    """
    try:
        is_there = folder.exists()
    except OSError:  # no permission for the parent
        is_there = False
    for wait_s in RETRY_S if is_there else ():
        time.sleep(wait_s)
        shutil.rmtree(folder, ignore_errors=True)


def check_room(path: Path, n_bytes: int) -> None:
    """
    Check that a file may grow to a size, before a library that does not survive a full disk writes it.

    Parameters
    ----------
    path : Path
        The file, which exists.
    n_bytes : int
        Its size when it is written.

    Raises
    ------
    OSError
        When the disk has not as much space left, or the process may not write files of that size.
    """
    if n_bytes > _file_size_limit():
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    if n_bytes - path.stat().st_size > _free_bytes(path.parent):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _raise_reason(error: Exception, target: Path, temporary: Path) -> None:
    """Raise the system's reason for an error in writing, where there is one."""
    reason = disk_problem(error) or _full(temporary)
    if not reason and isinstance(error, OSError):
        reason = error.strerror or str(error)
    if reason:
        raise FileError(target, f"cannot be written: {reason}") from None


def _full(temporary: Path) -> str:
    """Reason of the system why a file did not grow: some libraries do not pass it on."""
    with suppress(OSError):
        if temporary.is_file() and temporary.stat().st_size >= _file_size_limit():
            return os.strerror(errno.EFBIG)
        if _free_bytes(temporary.parent) < FULL_DISK_BYTES:
            return os.strerror(errno.ENOSPC)
    return ""


def _free_bytes(folder: Path) -> int:
    """Space that this process may use on a disk: some is kept for the superuser."""
    if hasattr(os, "statvfs") and os.geteuid() == 0:
        disk = os.statvfs(folder)
        return disk.f_bfree * disk.f_frsize
    return shutil.disk_usage(folder).free


def _file_size_limit() -> float:
    """Size in bytes that a file of this process may have."""
    try:
        import resource
    except ImportError:  # a system without such limits
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def lock(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed, whatever ends the program; False when another has it."""
    try:
        import fcntl
    except ImportError:  # a system without such locks
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
