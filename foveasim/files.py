"""Files and folders written whole or not at all, and locks on them."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from foveasim.errors import FileError

__all__ = ["folder_written_whole", "lock", "written_whole"]


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """
    A temporary name in the target's folder, renamed to the target when the block ends well, removed otherwise.

    The temporary name keeps the target's ending, by which libraries choose a format.

    Raises
    ------
    FileError
        When the folder does not exist, or writing fails: the disk is full, say.
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
        temporary.replace(target)
    except OSError as error:
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):  # a name too long for the system was never made
            temporary.unlink(missing_ok=True)


@contextmanager
def folder_written_whole(target: Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """
    A temporary folder, renamed to the target when the block ends well, removed otherwise.

    Raises
    ------
    FileError
        When something is there that is not ours, the folder around it does not exist, or writing fails.
    """
    if target.exists() and not is_ours(target):
        raise FileError(target, "cannot be written: something else is there")
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
    token = secrets.token_hex(8)
    new, old = (target.with_name(f".foveasim-{token}-{which}{target.suffix}") for which in ("new", "old"))
    try:
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    except OSError as error:
        if old.exists() and not target.exists():
            old.rename(target)
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None
    finally:
        for folder in (new, old):
            shutil.rmtree(folder, ignore_errors=True)


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
