"""Pages of the gallery: question, first figure, what it shows, then the script in steps with their figures."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import dedent

#: Beginning of a step in ``main``: the comment is its text.
STEP = re.compile(r" *# %% (.*)")
MAIN = "main"


@dataclass
class Step:
    """A part of a script: its text, its code, and the name of a definition."""

    text: str
    lines: list[str] = field(default_factory=list)
    name: str = ""

    @property
    def code(self) -> str:
        """The code, without indentation and blank lines around it."""
        return dedent("\n".join(self.lines)).strip("\n")


@dataclass
class Script:
    """
    A script of the gallery.

    Attributes
    ----------
    question, new, expect
        Parts of the docstring of the script, in Markdown.
    setup
        Imports and constants.
    definitions
        Functions and classes, with the summaries of their docstrings.
    steps
        Steps of ``main``.
    """

    question: str
    new: str
    expect: str
    setup: str
    definitions: list[Step]
    steps: list[Step]


def read_script(path: Path) -> Script:
    """Read the parts of a script: those of its docstring, its definitions, and the steps of ``main``."""
    source = path.read_text()
    module = ast.parse(source)
    paragraphs = [
        " ".join(each.split())
        for each in (ast.get_docstring(module) or "").replace("``", "`").split("\n\n")
    ]
    labelled = dict(each.split(": ", 1) for each in paragraphs[1:] if ": " in each)
    lines = source.splitlines()
    setup: list[str] = []
    definitions: list[Step] = []
    steps: list[Step] = []
    end = 0
    for node in module.body:
        first = (
            min(
                [
                    node.lineno,
                    *(each.lineno for each in getattr(node, "decorator_list", [])),
                ]
            )
            - 1
        )
        between, end = lines[end:first], node.end_lineno or first
        own = lines[first:end]
        if (isinstance(node, ast.Expr) and node is module.body[0]) or _runs_main(node):
            continue
        if isinstance(node, ast.FunctionDef) and node.name == MAIN:
            begin = (
                node.body[0].end_lineno
                if ast.get_docstring(node)
                else node.body[0].lineno - 1
            )
            steps = _steps(lines[begin:end])
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            definitions.append(
                Step((ast.get_docstring(node) or "").partition("\n")[0], own, node.name)
            )
        else:
            setup += [*between, *own]
    return Script(
        paragraphs[0],
        labelled.get("New here", ""),
        labelled.get("Expect", ""),
        "\n".join(setup).strip("\n"),
        definitions,
        steps,
    )


def page_of(path: Path, title: str, pictures: list[str], note: str = "") -> str:
    """
    Return the page of a script in Markdown.

    Parameters
    ----------
    path
        The script.
    title
        Title of the page.
    pictures
        Addresses of its figures relative to the page, in order.
    note
        Paragraph after the question.
    """
    script = read_script(path)
    left = list(pictures)
    parts = [f"# {title}", script.question, note]
    if left:
        first = left.pop(0)
        parts.append(_shown(first, script.question))
    if script.expect:
        parts.append(
            f"**What it shows.** {script.expect[0].upper()}{script.expect[1:]}"
        )
    if script.new:
        parts.append(f"**Used here:** {script.new}")
    parts += [
        "## Code",
        f"Complete script: {{download}}`{path.name} <../../gallery/{path.name}>`.",
    ]
    if script.setup:
        parts += ["Imports and settings:", _code(script.setup)]
    for definition in script.definitions:
        parts.append(
            f":::{{dropdown}} `{definition.name}`: {definition.text}\n{_code(definition.code)}\n:::"
        )
    for step in script.steps:
        parts += [step.text, _code(step.code)]
        names = re.findall(r"[\"']([\w.-]+\.(?:png|webp))[\"']", step.code)
        for picture in [each for each in left if Path(each).name in names]:
            parts.append(_shown(picture, step.text))
            left.remove(picture)
    parts += [_shown(picture, title) for picture in left]
    return "\n\n".join(part for part in parts if part) + "\n"


def _runs_main(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and "__name__" in ast.unparse(node.test)


def _steps(lines: list[str]) -> list[Step]:
    """Return the steps of the lines of ``main``; comments that follow the first line of a step belong to its text."""
    steps = [Step("")]
    is_text = False
    for line in lines:
        begins = STEP.match(line)
        if begins:
            steps.append(Step(begins[1]))
        elif is_text and line.lstrip().startswith("# "):
            steps[-1].text += " " + line.strip()[2:]
            continue
        else:
            steps[-1].lines.append(line)
        is_text = bool(begins)
    only_folder = (
        steps[0].code.startswith("out_dir.mkdir") and "\n" not in steps[0].code
    )
    return steps[1:] if only_folder or not steps[0].code else steps


def _code(text: str) -> str:
    return f"```python\n{text}\n```"


def _shown(picture: str, text: str) -> str:
    return f"![{text.replace('[', '(').replace(']', ')')}]({picture})"
