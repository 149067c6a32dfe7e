"""Directories that are written in steps by one process, and resumed after an interruption."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from foveasim._io.atomic import lock, remove_directory, rename_or_remove
from foveasim.errors import FileError

#: File that is locked while a directory is written, and extension of incomplete files of zarr.
LOCK, INCOMPLETE = "lock", ".partial"


def partial_path(path: str | Path) -> Path:
    """
    Return the directory in which an unfinished recording or capture is stored.

    It is in the same directory as the target, and exists until the last part is written.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.video.partial_path("codes.zarr").name
    'codes.zarr.partial'
    """
    target = Path(path)
    return target.with_name(target.name + ".partial")


class Unfinished(NamedTuple):
    """A locked directory that is written, with the file of its lock."""

    directory: Path
    lock: IO[bytes]

    def finish(self, target: Path) -> None:
        """Rename the complete directory to its target."""
        rename_or_remove(self.lock, lambda: self.directory.rename(target))
        (target / LOCK).unlink(missing_ok=True)


@contextmanager
def resumable_directory(
    target: Path, what: str, *, is_ours: Callable[[Path], bool], has_content: Callable[[Path], object]
) -> Iterator[Unfinished]:
    """
    Create or open the directory of an unfinished target, and lock it.

    ``target``: the finished directory; the unfinished one is :func:`partial_path`. ``what``: kind of the data, for messages.
    ``is_ours``: whether a directory contains such data. ``has_content``: whether a directory is worth resuming; if not, it is
    deleted after the block. Yields ``unfinished``, whose :meth:`~Unfinished.finish` is called at the end of the block. Raises
    FileError when the directory contains other data, or another process writes it.
    """
    directory = partial_path(target)
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the directory {target.parent} does not exist")
    if directory.exists() and not (directory.is_dir() and (_is_empty(directory) or is_ours(directory))):
        raise FileError(
            directory, f"cannot be written: the path contains other data than a {what}; choose another path"
        )
    with disk_errors(target):
        directory.mkdir(exist_ok=True)
        file = (directory / LOCK).open("ab")
    with file:
        with disk_errors(target):
            # Another process may have finished the target, or replaced the directory, before it was locked.
            if not lock(file) or not _is_same_file(file, directory / LOCK):
                raise FileError(target, "is being written by another process")
            for incomplete in directory.rglob(f"*{INCOMPLETE}"):
                incomplete.unlink()
        try:
            yield Unfinished(directory, file)
        finally:
            if directory.exists() and not has_content(directory):
                remove_directory(directory)
                if _is_same_file(file, directory / LOCK):  # Windows keeps open files
                    file.close()
                    remove_directory(directory)


@contextmanager
def disk_errors(target: Path) -> Iterator[None]:
    """Convert errors of the system, such as a full disk, to a FileError."""
    try:
        yield
    except OSError as error:
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None


def _is_empty(directory: Path) -> bool:
    """Whether a directory contains at most a lock and incomplete files."""
    return all(path.name == LOCK or path.suffix == INCOMPLETE for path in directory.iterdir())


def _is_same_file(file: IO[bytes], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
