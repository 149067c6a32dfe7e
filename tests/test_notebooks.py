"""Notebooks of the documentation run, and show what they announce."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from lazy_modules import LazyModule

nbformat, nbclient = LazyModule("nbformat"), LazyModule("nbclient")

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
#: Requirements of notebooks.
NEEDS = {"dataset_in_pytorch": [pytest.mark.needs("torch")], "lecture_in_3d": [pytest.mark.needs("renderer")]}
#: Message of the first run on a machine.
COMPILING = "compiling the kernels of "


def stems(paths):
    return [pytest.param(path, marks=NEEDS.get(path.stem, []), id=path.stem) for path in paths]


@pytest.mark.nightly
@pytest.mark.parametrize("path", stems(NOTEBOOKS))
def test_notebook_runs_and_shows_results(path, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    notebook = nbformat.read(path, 4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute(env={**os.environ, "IPYTHONDIR": str(tmp_path / "ipython")})

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = [output.text for output in outputs if output.output_type == "stream" and output.name == "stderr"]
    assert [text for text in printed if not text.startswith(COMPILING)] == []
    shown = {kind for output in outputs for kind in output.get("data", {})}
    assert shown & {"image/png", "text/html"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_notebook_has_no_outputs(path):
    notebook = nbformat.read(path, 4)
    nbformat.validate(notebook)

    assert notebook.cells[0].source.startswith("# ")
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook.cells)
