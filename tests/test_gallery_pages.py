"""Pages of the gallery: each script in steps, with its question, its figures and all of its code."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

import foveasim

REPOSITORY = Path(foveasim.__file__).parents[1]
SCRIPTS = sorted((REPOSITORY / "gallery").glob("*.py"))


@pytest.fixture
def pages(monkeypatch):
    spec = importlib.util.spec_from_file_location("gallery_pages", REPOSITORY / "docs" / "gallery_pages.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look their modules up
    spec.loader.exec_module(module)
    return module


def code_lines(text):
    """Return lines without indentation, comments that are text of steps, and blank ones."""
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("# ")]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_pages_contain_each_line_of_scripts(pages, path):
    source = path.read_text()
    shown = set(code_lines(pages.page_of(path, "Title", [])))
    module = ast.parse(source)
    (main,) = (node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    # On the page are neither the docstring of the script, nor the head of `main` and its folder, nor its call.
    hidden = [module.body[0], module.body[-1]]
    lines = source.splitlines()
    rest = [line for k, line in enumerate(lines, 1) if not any(n.lineno <= k <= n.end_lineno for n in hidden)]
    head = set(lines[main.lineno - 1 : main.body[0].end_lineno])
    missing = [line for line in code_lines("\n".join(each for each in rest if each not in head)) if line not in shown]

    assert [line for line in missing if not line.startswith("out_dir.mkdir(")] == []
    assert len(pages.read_script(path).steps) >= 2


def test_page_shows_figures_after_their_steps(pages, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        '"""\nHow many?\n\nNew here: ``one``.\n\nExpect: two lines\nof text.\n"""\n\nN = 1\n\n\n'
        'def double(n):\n    """Return twice a number."""\n    return 2 * n\n\n\n'
        'def main(out_dir):\n    """Write."""\n    # %% First step,\n    # continued.\n    save(out_dir / "a.png")\n'
        '    # %% Second step.\n    save(out_dir / "b.png")\n\n\nif __name__ == "__main__":\n    main(1)\n'
    )

    page = pages.page_of(script, "Title", ["s/a.png", "s/b.png", "s/c.png"])

    order = [
        "# Title",
        "How many?",
        "](s/a.png)",
        "Two lines of text.",
        "`one`",
        "N = 1",
        "`double`: Return twice",
        "First step, continued.",
        'save(out_dir / "a.png")',
        "Second step.",
        'save(out_dir / "b.png")',
        "](s/b.png)",
        "](s/c.png)",
    ]
    at = [page.index(part) for part in order]
    assert at == sorted(at)
    assert page.count("s/a.png") == 1
    assert "__main__" not in page
