"""Files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from foveasim.errors import FileError

__all__ = ["written_whole"]


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
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
    if target.is_dir():
        raise FileError(target, "cannot be written: it is a folder")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
    except OSError as error:
        raise FileError(target, f"cannot be written: {error.strerror}") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    except OSError as error:
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
