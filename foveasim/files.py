"""Files written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
