"""Checksums of the files that results depend on, including indirectly referenced files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from foveasim._io.yaml_files import read_yaml
from foveasim.config import YAML_EXTENSIONS, resolve_files
from foveasim.errors import ConfigError, FileError


def digests(files: Iterable[Path]) -> dict[str, str]:
    """
    Compute the SHA-256 of files and of the files that they reference.

    A layout file, for example, may reference the picture of a density.

    Returns ``digests``: by file path. Empty for a missing file; the reader of the file reports it.
    """
    digest_by_path: dict[str, str] = {}
    pending = list(files)
    while pending:
        file = pending.pop(0)
        if str(file) in digest_by_path:
            continue
        digest_by_path[str(file)] = _digest(file)
        if file.suffix.lower() in YAML_EXTENSIONS and file.is_file():
            pending += _referenced_files(file)
    return digest_by_path


def load_array(path: str | Path, *, mmap_mode: Literal["r"] | None = None) -> Any:
    """Read a ``.npy`` file of untrusted content."""
    try:
        return np.load(path, mmap_mode=mmap_mode, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FileError(path, f"is not a readable array ({error})") from None


def _referenced_files(file: Path) -> list[Path]:
    referenced: list[Path] = []
    try:
        resolve_files(file.parent, read_yaml(file), found=referenced)
    except ConfigError:  # reported when the settings are built
        return []
    return referenced


def _digest(file: Path) -> str:
    if not file.is_file():
        return ""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
