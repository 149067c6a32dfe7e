"""
Results of the code of a page, below each block: what it prints, draws and writes.

Blocks in the language ``sh`` are commands; those in ``bash`` are not run.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from docutils import nodes
from PIL import Image
from skimage.data import astronaut

#: Directory of the pictures of all pages.
RESULTS = Path(__file__).parent / "results"
#: Pictures that a page may write, and the largest number of them after one block.
PICTURES, MAX_PICTURES = (".png", ".webp"), 2
#: Longest output that a page shows, in lines and columns.
MAX_LINES, MAX_COLUMNS = 30, 88
DPI = 110.0
TIMEOUT_S = 300.0


class Session:
    """
    Blocks of one page, which share names and a directory with ``photo.jpg``.

    Parameters
    ----------
    page : str
        Name of the page, that of the directory of its pictures.
    """

    def __init__(self, page: str) -> None:
        self.pictures = RESULTS / page
        shutil.rmtree(self.pictures, ignore_errors=True)
        self.directory = Path(tempfile.mkdtemp())
        Image.fromarray(astronaut()).save(self.directory / "photo.jpg")
        self.names: dict[str, Any] = vars(ModuleType("__main__"))
        self.n_pictures = 0

    def run(self, code: str, language: str) -> tuple[str, list[Path]]:
        """Return what a block prints, and its pictures."""
        before = self._files()
        with contextlib.chdir(self.directory):
            run = self._python if language == "python" else self._commands
            printed, figures = run(code)
        written = [
            path for path, time in self._files().items() if before.get(path) != time
        ]
        copied = [
            Path(shutil.copy(path, self._next(path.suffix)))
            for path in written[: MAX_PICTURES - len(figures)]
        ]
        return "\n".join(shown_lines(printed)), [*figures, *copied]

    def close(self) -> None:
        """Delete the directory."""
        shutil.rmtree(self.directory, ignore_errors=True)

    def _files(self) -> dict[Path, int]:
        found = sorted(self.directory.rglob("*"))
        return {
            path: path.stat().st_mtime_ns for path in found if path.suffix in PICTURES
        }

    def _next(self, suffix: str) -> Path:
        self.pictures.mkdir(parents=True, exist_ok=True)
        self.n_pictures += 1
        return self.pictures / f"{self.n_pictures}{suffix}"

    def _python(self, code: str) -> tuple[str, list[Path]]:
        from dark_figures import with_dark_variants
        from matplotlib.artist import Artist

        import foveasim.view

        body = ast.parse(code).body
        if isinstance(body[-1], ast.Expr):
            body[-1] = ast.Assign([ast.Name("_", ast.Store())], body[-1].value)
        module = ast.fix_missing_locations(ast.Module(body, []))
        self.names["_"] = None
        printed, figures = io.StringIO(), []
        with contextlib.redirect_stdout(printed):
            exec(compile(module, "block", "exec"), self.names)  # noqa: S102 -- of pages
        value = self.names["_"]
        if isinstance(value, np.ndarray) and isinstance(value.flat[0], Artist):
            value = value.flat[0]
        if isinstance(value, Artist):
            figures.append(self._next(".png"))
            with with_dark_variants():
                foveasim.view.save_figure(value.figure, figures[0], dpi=DPI)
        elif value is not None and not isinstance(value, Path):
            printed.write(f"{value}\n")
        return printed.getvalue(), figures

    def _commands(self, code: str) -> tuple[str, list[Path]]:
        command = re.sub(
            r"^foveasim\b", f"{sys.executable} -m foveasim", code, flags=re.MULTILINE
        )
        done = subprocess.run(
            ["sh", "-ec", command],  # noqa: S607
            check=False,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            env={**os.environ, "COLUMNS": str(MAX_COLUMNS), "NO_COLOR": "1"},
        )
        if done.returncode:
            raise RuntimeError(f"{code}\n{done.stdout}{done.stderr}")
        return done.stdout, []


def shown_lines(text: str) -> Iterator[str]:
    """Yield the first lines of an output, and an ellipsis if there are more."""
    lines = text.rstrip().split("\n") if text.strip() else []
    for line in lines[:MAX_LINES]:
        if len(line) <= MAX_COLUMNS:
            yield line.rstrip()
        else:
            yield from textwrap.wrap(line, MAX_COLUMNS, subsequent_indent="    ")
    if len(lines) > MAX_LINES:
        yield "…"


def add_results(
    document: nodes.document, page: str, languages: tuple[str, ...]
) -> None:
    """Run the blocks of a page in some languages, and add their results to it."""
    session = Session(page)
    folder = Path(document["source"]).parent
    try:
        for block in list(document.findall(nodes.literal_block)):
            if block.get("language") not in languages:
                continue
            with np.printoptions(threshold=20, edgeitems=3, linewidth=MAX_COLUMNS):
                printed, pictures = session.run(block.astext(), block["language"])
            result = nodes.container(classes=["code-result"])
            if printed:
                result += nodes.literal_block(
                    printed, printed, language="text", classes=["output"]
                )
            for path in pictures:
                alt = f"Result of the code above in {document.next_node(nodes.title).astext()}"
                result += nodes.image(uri=os.path.relpath(path, folder), alt=alt)
            if result.children:
                block.parent.insert(block.parent.index(block) + 1, result)
    finally:
        session.close()
