"""The program in the process of the tests, which saves the start of an interpreter and the import of libraries."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from functools import partial

import pytest

from foveasim import cli
from foveasim._io.terminal import PlainConsole


def run_here(patch, read, *arguments, cwd, **environment):
    """
    Run the program in a directory; return exit code, standard output and standard error, as of a wide terminal.

    Modules of the directory, such as those of metrics, are forgotten.
    """
    read()
    known = set(sys.modules)
    with patch.context() as here, warnings.catch_warnings():
        warnings.simplefilter("default")
        here.chdir(cwd)
        here.setattr(sys, "argv", ["foveasim", *arguments])
        here.setattr(sys, "path", list(sys.path))
        for name, value in {"COLUMNS": "200", **environment}.items():
            here.setenv(name, value)
        here.setattr(cli, "console", PlainConsole())
        here.setattr(cli, "error_console", PlainConsole(stderr=True))
        with pytest.raises(SystemExit) as ended:
            cli.main()
    for name in set(sys.modules) - known:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(f"{cwd}{os.sep}"):
            del sys.modules[name]
    printed = read()
    return subprocess.CompletedProcess(arguments, ended.value.code or 0, printed.out, printed.err)


@pytest.fixture
def foveasim(monkeypatch, capsys):
    """Return a function that runs the program in this process."""
    return partial(run_here, monkeypatch, capsys.readouterr)
