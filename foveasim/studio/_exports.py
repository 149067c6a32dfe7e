"""Files of a state for other programs and other people: texts, notebook and archive."""

from __future__ import annotations

import difflib
import io
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foveasim import __version__
from foveasim._io.atomic import atomic_write
from foveasim._io.yaml_files import format_yaml
from foveasim.config import get_setting, to_python
from foveasim.errors import FoveasimError, ParameterError, SimulationError, printable
from foveasim.layout import Layout, write_layout
from foveasim.studio._files import file_name, is_unused_or_copy, unused_path
from foveasim.studio._messages.encoding import to_json
from foveasim.studio._messages.models import Save, SendText, handles
from foveasim.studio._settings.changes import changed_keys

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Date of the files in archives, so that equal states have equal archives; the earliest that the format can represent.
DATE = (1980, 1, 1, 0, 0, 0)
#: Longest value in a list of changes, characters.
MAX_VALUE_LENGTH = 60
#: Permissions of the files in archives: read by all, written by the owner.
PERMISSIONS = 0o644 << 16


def text_of(what: str, settings: Mapping[str, Any], start: Mapping[str, Any], name: str, files: Sequence[str]) -> str:
    """
    Return settings in a text format, or their changes as a difference.

    ``what``: {"yaml", "python", "notebook", "link", "diff"}. ``settings``, ``start``: current and initial settings. ``name``:
    name of the shot. ``files``: files that the settings contain, which must be next to the text. Raises ParameterError when
    the format is unknown.
    """
    note = note_of_files(files)
    match what:
        case "yaml":
            return note + format_yaml(settings)
        case "notebook":
            return notebook(settings, name, files)
        case "link":
            return json.dumps(to_json(settings), separators=(",", ":"))
        case "python":
            return note + to_python(settings)
        case "diff":
            old, new = (format_yaml(each).splitlines(keepends=True) for each in (start, settings))
            return "".join(difflib.unified_diff(old, new, f"{name}.yaml", "studio"))
        case _:
            raise ParameterError("what", "must be yaml, python, notebook, link or diff", printable(what)[:40])


def note_of_files(files: Sequence[str]) -> str:
    """Return a comment about the uploaded files that a file requires."""
    return f"# Uploaded files, next to this file: {', '.join(files)}\n" if files else ""


def log_of(states: Sequence[Mapping[str, Any]]) -> str:
    """Return a numbered list of the changes from each state to the next, with both values."""
    lines = []
    for number, (before, after) in enumerate(pairwise(states), 1):
        keys = changed_keys(after, before)
        changes = [f"{key}: {_short(get_setting(before, key))} → {_short(get_setting(after, key))}" for key in keys]
        lines.append(f"{number}. {'; '.join(changes)}")
    return "\n".join(lines)


def _short(value: Any) -> str:
    """Return a value in at most :data:`MAX_VALUE_LENGTH` characters."""
    text = "–" if value is None else json.dumps(to_json(value), ensure_ascii=False)
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[: MAX_VALUE_LENGTH - 1]}…"


def without_directories(
    settings: dict[str, Any], directories: Sequence[Path], frames: Mapping[str, Path], name_of: Callable[[Path], str]
) -> tuple[dict[str, Any], dict[str, Path]]:
    """
    Return settings with names for the paths of uploaded files, and the files by name.

    ``directories``: those of uploaded files. ``frames``: files that replace others, by the path in the settings. ``name_of``:
    returns the name of a file.
    """
    files: dict[str, Path] = {}

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: renamed(item) for name, item in value.items()}
        if isinstance(value, list):
            return [renamed(item) for item in value]
        if isinstance(value, str) and Path(value).parent in directories:
            file = frames.get(value, Path(value))
            name = name_of(file)
            files[name] = file
            return name
        return value

    return renamed(settings), files


def notebook(settings: Mapping[str, Any], name: str, files: Sequence[str]) -> str:
    """
    Return a notebook that simulates a shot and shows its picture and photosites.

    ``name``: heading. ``files``: files that the settings contain, which must be next to the notebook. Returns ``text``: JSON
    of notebook format 4.
    """
    needed = [f"Required next to this notebook: {', '.join(f'`{file}`' for file in files)}."] if files else []
    source = re.sub(r'\A""".*?"""\n', "", to_python(settings), flags=re.DOTALL).strip()
    cells = [
        _markdown(
            [f"# {name}", "", f"Simulation of a shot; written by the studio of foveasim {__version__}.", *needed]
        ),
        _code("%matplotlib inline"),
        _code(source),
        _markdown(["The reconstructed picture:"]),
        _code("capture.picture(max_pixels=1024)"),
        _markdown(["The photosites, coloured by their codes:"]),
        _code("fs.view.plot_capture(capture);"),
    ]
    content = {
        "cells": [{**cell, "id": f"cell-{k}"} for k, cell in enumerate(cells)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _markdown(lines: Sequence[str]) -> dict[str, Any]:
    return {"cell_type": "markdown", "metadata": {}, "source": "\n".join(lines)}


def _code(source: str) -> dict[str, Any]:
    return {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": [], "source": source}


def archive(name: str, texts: Mapping[str, str], files: Mapping[str, Path], layout: Layout | None) -> bytes:
    """
    Return a zip archive with all files of a state.

    ``name``: stem of the file of the layout. ``texts``: text files by name. ``files``: copied files by name. ``layout``:
    written as GDSII, or as GeoJSON without the extra ``layout``.
    """
    content = io.BytesIO()
    with tempfile.TemporaryDirectory(prefix="foveasim-studio-") as directory, zipfile.ZipFile(content, "w") as file:
        for text_name, text in texts.items():
            _add(file, text_name, text.encode())
        for copied, path in files.items():
            _add(file, copied, path.read_bytes())
        if layout is not None:
            path = _write_layout(layout, Path(directory) / f"{name}_layout")
            _add(file, path.name, path.read_bytes())
    return content.getvalue()


def _write_layout(layout: Layout, stem: Path) -> Path:
    """Write a layout as GDSII, or as GeoJSON without the extra, and return the path."""
    try:
        write_layout(layout, path := stem.with_name(f"{stem.name}.gds"))
    except FoveasimError:
        write_layout(layout, path := stem.with_name(f"{stem.name}.geojson"))
    return path


def _add(file: zipfile.ZipFile, name: str, content: bytes) -> None:
    entry = zipfile.ZipInfo(name, DATE)
    entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, PERMISSIONS
    file.writestr(entry, content)


def save(session: Session, path: Path, text: str = "") -> None:
    """
    Write the settings of a session to a file, with copies of uploaded files next to it.

    ``text``: comments at the beginning of the file.
    """
    out = path.parent
    out.mkdir(parents=True, exist_ok=True)
    originals = {path.name.casefold(): path}  # some file systems ignore the case of letters

    def name_of(original: Path) -> str:
        """Return a name that no other file has, of these settings or of those saved before."""

        def is_usable(copied: Path) -> bool:
            known = originals.get(copied.name.casefold(), original)
            return known == original and is_unused_or_copy(copied, original)

        copied = unused_path(out / original.name, is_usable)
        originals[copied.name.casefold()] = original
        return copied.name

    settings, files = session.exported(name_of)
    for copied, original in files.items():
        with atomic_write(out / copied) as temporary:
            shutil.copyfile(original, temporary)
    with atomic_write(path) as temporary:
        temporary.write_text(text + format_yaml(settings), encoding="utf-8")


@handles(Save)
def _save(session: Session, message: Save) -> None:
    out, safe = session.start.out, file_name(message.name)
    if out is None:
        raise SimulationError("files are written only with --out; use the download instead")
    path = out / (safe if safe.endswith((".yaml", ".yml")) else f"{safe}.yaml")
    if path.exists() and not message.may_replace:
        session.send({"kind": "exists", "id": message.id, "name": message.name, "file": path.name})
    else:
        save(session, path)
        session.send({"kind": "saved", "id": message.id, "path": str(path)})


@handles(SendText)
def _send_text(session: Session, message: SendText) -> None:
    exported = session.exported()
    session.send_text(message.id, message.what, session.text(message.what, exported), list(exported[1]))
