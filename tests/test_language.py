"""The vocabulary of everything that people read: wrong terms are found, summaries and test names are short."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
#: Terms that are wrong in this field, by what to write instead. Everyday English is free.
PHRASES = {
    "power map": r"\bmaps? of light\b",
    "read noise, reset noise": r"\bnoise of (reading|resetting)\b",
    "photon shot noise, dark-current shot noise": r"\bshot of (light|dark)",
    "pitch": r"\bdistance of two (pixels|sites)\b",
    "satisfy, violate rules": r"\brules? (is|are) (broken|kept)\b|\bbroken rules?\b",
    "per site, per second": r"\b(values?|numbers?|frames?) an? (site|second|frame|pixel|core|band)\b",
}
FORBIDDEN = {term: re.compile(phrase, re.IGNORECASE) for term, phrase in PHRASES.items()}
#: A docstring begins with a verb in the imperative, or with a noun.
BAD_OPENING = re.compile(r"(What|How|Where|Which|Those|That|Who)\b")
MOST_CHARACTERS = 88
TEST = re.compile(r"^[ ]*def (test_\w+)", re.MULTILINE)
WORDS = range(3, 8)


class Text(NamedTuple):
    """A comment, a string, a test's name, or a line of a document."""

    path: str
    line: int
    words: str


def texts_of_python(path: str, source: str) -> list[Text]:
    """Comments and strings, and the names of tests with spaces for underscores."""
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)}
    texts = [
        Text(path, token.start[0] + k, line)
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type in kinds
        for k, line in enumerate(token.string.splitlines())
    ]
    return texts + [Text(path, line, name.replace("_", " ")) for line, name in names_of_tests(source)]


def texts(path: str) -> list[Text]:
    """All that people read in a file of the repository."""
    return texts_of(path, (ROOT / path).read_text("utf-8"))


def texts_of(path: str, source: str) -> list[Text]:
    """All that people read in a source."""
    if path.endswith(".py"):
        return texts_of_python(path, source)
    return [Text(path, k, line) for k, line in enumerate(source.splitlines(), 1)]


def names_of_tests(source: str) -> list[tuple[int, str]]:
    """Line and name of every test."""
    return [(source.count("\n", 0, match.start()) + 1, match[1]) for match in TEST.finditer(source)]


def summaries(source: str) -> list[tuple[int, str]]:
    """Line and first paragraph of every docstring."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, documented) and (docstring := ast.get_docstring(node)):
            line = node.body[0].lineno
            found.append((line, docstring.partition("\n\n")[0]))
    return found


def phrases_found(texts: list[Text]) -> list[str]:
    """Every phrase with a standard term, where it is, and the term."""
    return [
        f"{text.path}:{text.line}: '{match[0]}' -> {term}"
        for text in texts
        for term, pattern in FORBIDDEN.items()
        for match in pattern.finditer(text.words)
    ]


def bad_summaries(path: str) -> list[str]:
    """Summaries of docstrings that are longer than one line, or begin with a relative or interrogative word."""
    found = []
    for line, summary in summaries((ROOT / path).read_text("utf-8")):
        if BAD_OPENING.match(summary):
            found.append(f"{path}:{line}: begins with '{summary.split()[0]}', not with a verb or noun")
        if "\n" in summary or len(summary) > MOST_CHARACTERS:
            found.append(f"{path}:{line}: {len(summary)} characters, at most {MOST_CHARACTERS} on one line")
    return found


def files() -> list[str]:
    """Files of the repository that contain prose; this one lists the phrases."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "*.py", "*.md", "*.yaml", "*.yml", "*.cff"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    paths = {ROOT / name for name in listed.stdout.splitlines()} - {Path(__file__)}
    return sorted(path.relative_to(ROOT).as_posix() for path in paths if path.is_file())


FILES = files()
PYTHON = [path for path in FILES if path.endswith(".py")]
TESTS = [path for path in PYTHON if path.startswith("tests/")]
PACKAGE = [path for path in PYTHON if path.startswith("foveasim/")]


def has_phrase(path: str) -> bool:
    """Whether the file contains a phrase anywhere, which is much faster than to find its texts."""
    source = (ROOT / path).read_text("utf-8")
    words = source + "".join("\n" + name.replace("_", " ") for _, name in names_of_tests(source))
    words = words.lower()  # case-insensitive patterns are slow
    return any(re.search(phrase.lower(), words) for phrase in PHRASES.values())


def test_prose_uses_standard_terms():
    found = [line for path in FILES if has_phrase(path) for line in phrases_found(texts(path))]
    assert not found, f"{len(found)} phrases\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("path", "source", "phrase"),
    [
        ("planted.py", '"""Read a map of light."""\n', "map of light"),
        ("planted.py", "x = 1  # one value a site\n", "value a site"),
        ("planted.py", "def test_broken_rules_are_found():\n    pass\n", "broken rules"),
        ("planted.md", "# Title\n\nThe noise of reading adds up.\n", "noise of reading"),
        ("planted.yaml", "# the distance of two pixels\n", "distance of two pixels"),
    ],
)
def test_planted_phrases_are_found(path, source, phrase):
    found = texts_of(path, source)
    assert [line.split("'")[1] for line in phrases_found(found)] == [phrase]


def test_docstring_summaries_are_short_phrases():
    found = [line for path in PACKAGE for line in bad_summaries(path)]
    assert not found, f"{len(found)} summaries\n" + "\n".join(found)


def test_test_names_have_few_words():
    names = [(path, *named) for path in TESTS for named in names_of_tests((ROOT / path).read_text("utf-8"))]
    found = [f"{path}:{line}: {name}" for path, line, name in names if len(name.split("_")) - 1 not in WORDS]
    assert not found, f"{len(found)} names\n" + "\n".join(found)
