"""Atomic writes of files and directories, and file locks."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from foveasim.errors import FileError, disk_problem

#: A disk with less free space than one block is full.
FULL_DISK_BYTES = 4096
#: Position of the byte that is locked on Windows, where no other program can read it: beyond the content of all files.
LOCKED_BYTE = 2**31 - 2
#: Waiting times before each attempt to remove a directory.
RETRY_S = (0.0, 0.05, 0.25)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """
    Yield a temporary path that replaces the target if the block succeeds.

    If the block fails, the temporary file is removed. The temporary path is in the same directory and has the same
    extension as the target, because libraries choose the format by extension. Raises FileError when the directory does not
    exist, or writing fails, for example on a full disk.
    """
    target = Path(path)
    temporary = target.with_name(f".foveasim-{secrets.token_hex(8)}{target.suffix}")
    try:
        if not target.parent.is_dir():
            raise FileError(target, f"cannot be written: the directory {target.parent} does not exist")
        if target.is_dir():
            raise FileError(target, "cannot be written: it is a directory")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        if reason := _full(temporary):  # some libraries ignore a full disk and leave a truncated file
            raise FileError(target, f"cannot be written: {reason}")
        temporary.replace(target)
    except Exception as error:
        _raise_reason(error, target, temporary)
        raise
    finally:
        with suppress(OSError):  # a name too long for the system was never created
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_files(*targets: Path) -> Iterator[list[Path]]:
    """
    Yield temporary paths that replace all targets if the block succeeds, else none.

    See :func:`atomic_write`.
    """
    problem: FileError | None = None
    try:
        with ExitStack() as stack:
            temporaries = [stack.enter_context(atomic_write(target)) for target in targets]
            try:
                yield temporaries
            except FileError as error:
                if error.path in temporaries:
                    problem = FileError(targets[temporaries.index(error.path)], error.detail)
                raise
    except FileError as error:
        raise problem or error from None


@contextmanager
def atomic_directory(target: Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """
    Yield a temporary directory that replaces the target if the block succeeds.

    If the block fails, the temporary directory is removed.

    Raises FileError when the target exists and ``is_ours`` is false for it, its parent directory does not exist, or writing
    fails.
    """
    token = secrets.token_hex(8)
    new, old = (target.with_name(f".foveasim-{token}-{label}{target.suffix}") for label in ("new", "old"))
    try:
        if target.exists() and not is_ours(target):
            raise FileError(target, "cannot be written: the path contains other data; choose another path")
        if not target.parent.is_dir():
            raise FileError(target, f"cannot be written: the directory {target.parent} does not exist")
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    except Exception as error:
        with suppress(OSError):  # no permission for the directory
            if old.exists() and not target.exists():
                old.rename(target)
        _raise_reason(error, target, new)
        raise
    finally:
        for directory in (new, old):
            remove_directory(directory)


def remove_directory(directory: Path) -> None:
    """
    Remove a directory and its contents if it exists; ignore errors of the system.

    After an error, threads of zarr may continue to write for a short time and create the directory again.
    """
    try:
        exists = directory.exists()
    except OSError:  # no permission for the parent directory
        exists = False
    for wait_s in RETRY_S if exists else ():
        time.sleep(wait_s)
        shutil.rmtree(directory, ignore_errors=True)


def check_free_space(path: Path, n_bytes: int) -> None:
    """
    Check that the disk has space for a file, before a library that crashes on a full disk.

    ``path``: an existing file. ``n_bytes``: size of the file after writing. Raises OSError when the disk has too little free
    space, or the size exceeds the file size limit of the process.
    """
    if n_bytes > _file_size_limit():
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    if n_bytes - path.stat().st_size > _free_bytes(path.parent):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _raise_reason(error: Exception, target: Path, temporary: Path) -> None:
    """Raise a FileError with the reason of the system for a write error, if there is one."""
    reason = disk_problem(error) or _full(temporary)
    if not reason and isinstance(error, OSError):
        reason = error.strerror or str(error)
    if reason:
        raise FileError(target, f"cannot be written: {reason}") from None


def _full(temporary: Path) -> str:
    """Return the system's message for a full disk or too large a file, else ``""``."""
    with suppress(OSError):
        if temporary.is_file() and temporary.stat().st_size >= _file_size_limit():
            return os.strerror(errno.EFBIG)
        if _free_bytes(temporary.parent) < FULL_DISK_BYTES:
            return os.strerror(errno.ENOSPC)
    return ""


def _free_bytes(directory: Path) -> int:
    """Return the free space of a disk; the superuser may also use the reserved space."""
    if hasattr(os, "statvfs") and os.geteuid() == 0:
        disk = os.statvfs(directory)
        return disk.f_bfree * disk.f_frsize
    return shutil.disk_usage(directory).free


def _file_size_limit() -> float:
    """Return the file size limit of this process in bytes."""
    try:
        import resource
    except ImportError:  # the system has no resource limits
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def lock(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed; return False if another process has the lock."""
    try:
        import fcntl
    except ImportError:
        return _lock_byte(file.fileno())
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _lock_byte(fd: int) -> bool:
    """Lock a byte of an open file, as Windows can; True where the system has no file locks."""
    try:
        import msvcrt
    except ImportError:
        return True
    system: Any = msvcrt
    position = os.lseek(fd, 0, os.SEEK_CUR)
    os.lseek(fd, LOCKED_BYTE, os.SEEK_SET)
    try:
        system.locking(fd, system.LK_NBLCK, 1)
    except OSError:
        return False
    finally:
        os.lseek(fd, position, os.SEEK_SET)
    return True


def rename_or_remove(file: IO[bytes], action: Callable[[], object]) -> None:
    """
    Rename or remove a locked file, or a directory that contains it.

    The lock is held meanwhile where the system permits this; on Windows, the file is closed before.
    """
    try:
        action()
    except PermissionError:
        file.close()
        action()
