"""Docstrings in numpydoc format: summary, sections, descriptions of parameters."""

from __future__ import annotations

import inspect
from itertools import pairwise
from typing import Any, NamedTuple


class Docstring(NamedTuple):
    """Text before the sections, and the lines of each section by its title."""

    introduction: str
    sections: dict[str, list[str]]

    @classmethod
    def of(cls, documented: Any) -> Docstring:
        """Return the docstring of a function or class; empty without one."""
        lines = (inspect.getdoc(documented) or "").splitlines()
        starts = [k for k, line in enumerate(lines[1:]) if line and not line.strip("-") and len(line) == len(lines[k])]
        sections = {lines[k]: lines[k + 2 : end] for k, end in pairwise([*starts, len(lines)])}
        return cls("\n".join(lines[: starts[0] if starts else None]).rstrip(), sections)

    @property
    def summary(self) -> str:
        """First paragraph, in one line."""
        return self.introduction.split("\n\n")[0].replace("\n", " ")

    @property
    def parameters(self) -> dict[str, str]:
        """Descriptions of the parameters."""
        found: dict[str, str] = {}
        names: list[str] = []
        for line in self.sections.get("Parameters", ()):
            if line.startswith("    "):
                found |= {name: f"{found.get(name, '')} {line.strip()}".strip() for name in names}
            elif line:
                names = [name.strip() for name in line.partition(" : ")[0].split(",")]
        return found

    def without_first_parameter(self) -> str:
        """Return the text of a method: its first parameter is the object."""
        lines = self.sections.get("Parameters", [])
        second = next((k for k, line in enumerate(lines[1:], 1) if line and not line.startswith(" ")), None)
        kept = {"Parameters": [] if second is None else lines[second:]}
        sections = [f"{title}\n{'-' * len(title)}\n" + "\n".join(kept.get(title, body)).rstrip()
                    for title, body in self.sections.items() if kept.get(title, body)]  # fmt: skip
        return "\n\n".join([self.introduction, *sections])
