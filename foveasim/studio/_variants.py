"""Variants: named states of a session with notes, each in a settings file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foveasim._io.atomic import atomic_write
from foveasim._io.yaml_files import read_text, read_yaml
from foveasim.config import resolve_files
from foveasim.errors import FileError, FoveasimError, ParameterError, printable
from foveasim.studio._engine import Simulated
from foveasim.studio._files import file_name, unused_path, with_preset
from foveasim.studio._messages.models import ApplyVariant, ChangeVariant, CompareVariants, Freeze, Unfreeze, handles
from foveasim.studio._parts import PARTS, summary_of
from foveasim.studio._parts.comparison import FROZEN

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Directory of the variants, in that of saved files.
DIRECTORY = "variants"
EXTENSION = ".yaml"
#: Longest name and note, characters, and largest number of variants.
MAX_NAME_LENGTH, MAX_NOTE_LENGTH, MAX_VARIANTS = 80, 1000, 200
#: Comments at the beginning of a file: the name, then the lines of the note.
COMMENT = "# "
_COMMENTS = re.compile(r"\A(#.*\n)*")


@dataclass(frozen=True)
class Variant:
    """
    A named state.

    ``id``: stem of its file. ``name``, ``note``: texts of the user.
    """

    id: str
    name: str
    note: str


class Variants:
    """
    Variants in a directory, which is created with the first one.

    Their files are those of a shot: ``foveasim run`` simulates them. Uploaded pictures that they contain are next to them.

    ``write``: writes the settings of the session to a file, with a text before them and copies of uploaded files.
    """

    def __init__(self, directory: Path, write: Callable[[Path, str], None]) -> None:
        self.directory, self._write = directory, write

    def __iter__(self) -> Iterator[Variant]:
        """Return all variants by name, with numbers in order of their value."""
        paths = [path for path in self.directory.glob(f"*{EXTENSION}") if not path.name.startswith(".")]
        return iter(sorted((_described(path) for path in paths), key=lambda each: (_in_order(each.name), each.id)))

    def path_of(self, variant: str) -> Path:
        """
        Return the file of a variant.

        Raises ParameterError when there is no such variant.
        """
        path = self.directory / f"{variant}{EXTENSION}"
        if variant != Path(variant).name or variant.startswith(".") or not path.is_file():
            raise ParameterError("variant", "must be one of the session", printable(variant)[:40])
        return path

    def keep(self, name: str, note: str = "") -> str:
        """
        Keep the present state as a variant, and return its identifier.

        Raises ParameterError when the name is empty or too long, the note is too long, or there are too many variants.
        """
        text = _comments(name, note)
        if len(list(self)) >= MAX_VARIANTS:
            raise ParameterError("variants", f"must be at most {MAX_VARIANTS}; delete some first")
        self.directory.mkdir(parents=True, exist_ok=True)
        path = unused_path(
            self.directory / f"{file_name(name).replace('.', '_')}{EXTENSION}", lambda each: not each.exists()
        )
        self._write(path, text)
        return path.stem

    def update(self, variant: str) -> None:
        """Replace the state of a variant by the present one."""
        path = self.path_of(variant)
        found = _described(path)
        self._write(path, _comments(found.name, found.note))

    def describe(self, variant: str, name: str, note: str) -> None:
        """Change the name and the note of a variant."""
        path, text = self.path_of(variant), _comments(name, note)
        settings = _COMMENTS.sub("", read_text(path), count=1)
        with atomic_write(path) as temporary:
            temporary.write_text(text + settings, encoding="utf-8")

    def delete(self, variant: str) -> None:
        """Delete a variant, and the pictures that no other one contains."""
        path = self.path_of(variant)
        own = _files_of(path)
        path.unlink()
        others = {file for each in self for file in _files_of(self.path_of(each.id))}
        for file in own - others:
            if file.parent == self.directory:
                file.unlink(missing_ok=True)

    def settings_of(self, variant: str) -> dict[str, Any]:
        """
        Return the settings of a variant, with absolute paths.

        Raises FileError when the file is not valid YAML.
        """
        path = self.path_of(variant)
        settings = read_yaml(path)
        if not isinstance(settings, dict):
            raise FileError(path, "must contain the settings of a shot")
        return dict(resolve_files(path.parent.absolute(), with_preset(settings)))


def _files_of(path: Path) -> set[Path]:
    """Return the files that the settings in a file contain; none if it cannot be read."""
    found: list[Path] = []
    try:
        resolve_files(path.parent.absolute(), read_yaml(path), found=found)
    except (FileError, ValueError):
        return set()
    return set(found)


def _described(path: Path) -> Variant:
    """Return the variant in a file; its name is that of the file if there are no comments."""
    try:
        comments = _COMMENTS.match(read_text(path))
    except FileError:
        comments = None
    name, *note = [line.removeprefix("#").strip() for line in (comments.group() if comments else "").splitlines()] or [
        ""
    ]
    return Variant(path.stem, (name or path.stem)[:MAX_NAME_LENGTH], "\n".join(note)[:MAX_NOTE_LENGTH])


def _comments(name: str, note: str) -> str:
    """Return a name and a note as comments of YAML."""
    if not 0 < len(name.strip()) <= MAX_NAME_LENGTH:
        raise ParameterError("name", f"must have 1 to {MAX_NAME_LENGTH} characters")
    if len(note) > MAX_NOTE_LENGTH:
        raise ParameterError("note", f"must have at most {MAX_NOTE_LENGTH} characters")
    lines = [" ".join(name.split()), *note.strip().splitlines()]
    return "".join(f"{COMMENT}{printable(line)}".rstrip() + "\n" for line in lines)


def _in_order(name: str) -> list[tuple[int, str]]:
    """Return a key in which numbers have the order of their values."""
    return [(int(part), "") if part.isdecimal() else (0, part.casefold()) for part in re.split(r"(\d+)", name)]


class Compared:
    """Results of A, which is frozen, and of variants that are compared with the current state."""

    def __init__(self) -> None:
        #: Summary and settings of A.
        self.frozen: dict[str, Any] | None = None
        self.frozen_result: Simulated | None = None
        #: Settings and results of variants, and the errors of others.
        self.results: dict[str, tuple[dict[str, Any], Simulated]] = {}
        self.problems: dict[str, str] = {}

    def release(self) -> None:
        """Release the results; A is simulated again for the next page."""
        self.frozen_result, self.results = None, {}

    def simulate_frozen(self, simulate: Callable[[dict[str, Any]], Simulated]) -> None:
        """Simulate A again, whose result was released; without its files it is removed."""
        if self.frozen is None or self.frozen_result is not None:
            return
        try:
            self.frozen_result = simulate(self.frozen["settings"])
        except FoveasimError:
            self.frozen = None

    def shown(self, variants: Variants) -> tuple[tuple[str, Simulated], ...]:
        """Return the names and results of those that are compared, A first."""
        names = {each.id: each.name for each in variants} if self.results else {}
        named = [(names.get(variant, variant), result) for variant, (_, result) in self.results.items()]
        return (*(() if self.frozen_result is None else ((FROZEN, self.frozen_result),)), *named)

    def about(self, variants: Variants) -> list[dict[str, Any]]:
        """Return all variants as plain data."""
        return [
            {**vars(each), "is_compared": each.id in self.results, "problem": self.problems.get(each.id)}
            for each in variants
        ]


@handles(ApplyVariant)
def _apply(session: Session, message: ApplyVariant) -> dict[str, Any]:
    return session.variants.settings_of(message.variant)


@handles(Freeze)
def _freeze(session: Session, message: Freeze) -> None:
    """Keep a result as A; the page keeps what is sent before the next change."""
    current, settings = session.complete_result(), session.history.settings
    if message.variant is not None:
        session.send({"kind": "busy"})
        settings = session.files.resolve(session.variants.settings_of(message.variant))
        session.use(session.engine.simulate(settings))
    frozen = session.required_result("freeze")
    session.compared.frozen_result = frozen
    session.compared.frozen = {"summary": summary_of(frozen), "settings": settings}
    session.send_parts(is_freeze=True, is_followed=message.variant is not None)
    if message.variant is not None:
        session.use(current)


@handles(Unfreeze)
def _unfreeze(session: Session, _message: Unfreeze) -> None:
    session.compared.frozen = session.compared.frozen_result = None
    _forget_views(session)


@handles(ChangeVariant)
def _change(session: Session, message: ChangeVariant) -> None:
    match message.action:
        case "keep":
            session.variants.keep(message.name, message.note)
        case "update":
            session.variants.update(message.variant)
        case "describe":
            session.variants.describe(message.variant, message.name, message.note)
        case "delete":
            session.variants.delete(message.variant)
    _simulate_compared(session, [each.id for each in session.variants if each.id in session.compared.results])


@handles(CompareVariants)
def _compare(session: Session, message: CompareVariants) -> None:
    _simulate_compared(session, message.variants)


def _simulate_compared(session: Session, wanted: list[str]) -> None:
    """Simulate variants that are compared; those that fail are left out, with the reason."""
    session.send({"kind": "busy"})
    compared = session.compared
    before, compared.results, compared.problems = compared.results, {}, {}
    for variant in dict.fromkeys(wanted):
        try:
            settings = session.files.resolve(session.variants.settings_of(variant))
            known = before.get(variant)
            if known is None or known[0] != settings:
                known = settings, session.engine.simulate(settings)
            compared.results[variant] = known
        except FoveasimError as error:
            compared.problems[variant] = session.line(error)
    _forget_views(session)


def _forget_views(session: Session) -> None:
    """Send views of variants again when the next variant is compared."""
    if not session.compared.shown(session.variants):
        for part in PARTS.values():
            if part.is_of_variants:
                session.views.forget(part.name)
