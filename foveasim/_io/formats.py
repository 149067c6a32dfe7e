"""File formats: detection, readers, writers and options."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foveasim._core.names import did_you_mean, missing_path, possible_names
from foveasim._core.short_repr import short_repr
from foveasim.errors import FileError, FoveasimError, ParameterError, format_value

#: Size limit of files that are read.
MAX_FILE_BYTES = 8 * 2**30
HEAD_BYTES = 1024
#: Most characters of a message of this package, and of other packages.
MAX_MESSAGE_LENGTH, MAX_REASON_LENGTH = 500, 300
#: Messages for files of unsupported types, by their first bytes.
_HINTS = {
    b"\x1f\x8b": "is compressed with gzip; decompress it first",
    b"<": "is markup; SVG files can be written but not read",
}


@dataclass(frozen=True, kw_only=True)
class FileFormat:
    """
    A file format; entry of a table of formats.

    Parameters
    ----------
    title : str
        Name in messages.
    suffixes : tuple of str
        File extensions with the dot, in lower case; the first is the default.
    signatures : tuple of bytes
        First bytes of files of the format.
    matches : callable, optional
        Function of the path and the first bytes that returns whether a file is of the format; used instead of signatures.
    read, write : callable, optional
        Reader and writer; None if the format is not read or not written.
    read_options, write_options : tuple of str
        Keywords of ``read`` and ``write`` that users may set.
    is_sandboxed : bool
        Whether files are read in the sandbox process, because malformed files can crash the library.
    is_silent : bool
        Whether output of the library on standard output means that a file is corrupt.
    is_directory : bool
        Whether the format is a directory, which ``write`` itself writes atomically.
    """

    title: str
    suffixes: tuple[str, ...]
    signatures: tuple[bytes, ...] = ()
    matches: Callable[[Path, bytes], bool] | None = None
    read: Callable[..., Any] | None = None
    write: Callable[..., Any] | None = None
    read_options: tuple[str, ...] = ()
    write_options: tuple[str, ...] = ()
    is_sandboxed: bool = False
    is_silent: bool = False
    is_directory: bool = False

    __repr__ = short_repr

    def matches_file(self, path: Path, head: bytes) -> bool:
        """Return whether a file with these first bytes is of the format."""
        if self.matches is not None:
            return self.matches(path, head)
        return bool(self.signatures) and head.startswith(self.signatures)


class FormatError(Exception):
    """Invalid content of a file; the message does not contain the path."""


def listed_file(index: Path, name: str, *, allow_outside: bool = False) -> Path:
    """
    Return the path of a file that an index names, relative to its directory.

    Raises FormatError when it is in another directory, without ``allow_outside``, or does not exist. The message does not tell
    whether a file outside exists.
    """
    file = index.parent / name
    if not allow_outside and not file.resolve().is_relative_to(index.parent.resolve()):
        raise FormatError(f"lists {name!r:.80}, outside its directory; move the file, or pass allow_outside=True")
    if not file.is_file():
        raise FormatError(f"lists {name!r:.80}, which does not exist")
    return file


@contextmanager
def as_file_error(path: Path, what: str, *, passes: tuple[type[FoveasimError], ...] = ()) -> Iterator[None]:
    """
    Convert exceptions of readers of malformed files to a FileError with a one-line message.

    ``what``: expected kind of the file, for messages: ``"power map"``. ``passes``: types of exceptions that are raised
    unchanged.
    """
    try:
        yield
    except passes:
        raise
    except (FormatError, FoveasimError) as error:
        if isinstance(error, FileError) and error.path == path:
            raise FileError(path, one_line(error.detail, MAX_MESSAGE_LENGTH), position=error.position) from None
        raise FileError(path, one_line(str(error), MAX_MESSAGE_LENGTH)) from None
    except MemoryError:
        raise FileError(path, "needs more memory than is available") from None
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on malformed files
        reason = one_line(str(error), MAX_REASON_LENGTH) or type(error).__name__
        raise FileError(path, f"is corrupt or not a valid {what} ({reason})") from None


def check_version(path: Path, about: Any, what: str, file_format: str, version: int) -> None:
    """Check the values of ``format`` and ``version`` in the metadata of a file of the package."""
    if not isinstance(about, Mapping) or about.get("format") != file_format:
        raise FileError(path, f"is not a valid {what}")
    if about.get("version") != version:
        raise FileError(path, f"has the format version {format_value(about.get('version'))}, expected {version}")


def one_line(text: str, max_characters: int) -> str:
    """Return an untrusted message as one printable line of limited length."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text[: 2 * max_characters]).split())
    return line if len(line) <= max_characters else line[: max_characters - 3] + "..."


def read_head(path: Path) -> bytes:
    """
    Return the first bytes of a file.

    Raises FileError when the file is missing, unreadable, empty or too large.
    """
    try:
        if not path.is_file():
            raise FileError(path, missing_path(path))
        n_bytes = path.stat().st_size
        if n_bytes > MAX_FILE_BYTES:
            raise FileError(path, f"has {n_bytes} bytes, more than the limit of {MAX_FILE_BYTES}")
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except FileError:
        raise
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be opened: {getattr(error, 'strerror', None) or error}") from None
    if not head:
        raise FileError(path, "is empty")
    return head


def detect_format(path: Path, formats: Mapping[str, FileFormat], what: str) -> tuple[str, FileFormat]:
    """
    Return the name and the entry of a file's format in a table, detected by content.

    Raises FileError when the file cannot be read, or no readable format of the table matches.
    """
    head = b"" if path.is_dir() else read_head(path)
    for name, found in formats.items():
        if found.read is not None and found.matches_file(path, head):
            return name, found
    head = head or read_head(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for beginning, hint in _HINTS.items():
        if text.startswith(beginning):
            raise FileError(path, hint)
    titles = sorted({found.title for found in formats.values() if found.read is not None}, key=str.lower)
    raise FileError(path, f"is not a valid {what}: expected {', '.join(titles[:-1])} or {titles[-1]}")


def select_writer(path: Path, formats: Mapping[str, FileFormat]) -> FileFormat:
    """Return the writable format of a table that has a file's extension, or raise a FileError."""
    by_suffix = {suffix: found for found in formats.values() if found.write is not None for suffix in found.suffixes}
    try:
        return by_suffix[path.suffix.lower()]
    except KeyError:
        hint = did_you_mean(path.suffix, by_suffix) if path.suffix else ""
        raise FileError(path, f"must end in one of {', '.join(sorted(by_suffix))}{'; ' * bool(hint)}{hint}") from None


def _listed(titles: list[str]) -> str:
    return " and ".join([*([", ".join(titles[:-1])] if titles[1:] else []), titles[-1]])


def validate_options(
    options: Mapping[str, Any], known: tuple[str, ...], formats: Mapping[str, FileFormat], of: str
) -> dict[str, Any]:
    """
    Return the options, by name, that are not None; raise a ParameterError for unknown ones.

    ``known``: names of the options of the file's format. ``formats``, ``of``: table of all formats and their attribute with
    names of options, ``"read_options"`` or ``"write_options"``, for messages.
    """
    given = {name: value for name, value in options.items() if value is not None}
    for name, value in given.items():
        if name not in known:
            titles = sorted({found.title for found in formats.values() if name in getattr(found, of)})
            rule = f"is an option of {_listed(titles)} files only" if titles else "is not an option of any format"
            every = sorted({option for found in formats.values() for option in getattr(found, of)})
            hint = "omit it" if titles else possible_names(name, every)
            raise ParameterError(name, rule, value, hint=hint)
    return given
