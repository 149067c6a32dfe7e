"""The program in the process of the tests, which saves the start of an interpreter and the import of libraries."""

from __future__ import annotations

import subprocess
import sys
import warnings

import pytest

from foveasim import cli
from foveasim._io.terminal import PlainConsole


@pytest.fixture
def foveasim(monkeypatch, capsys):
    """Run the program in a directory; return exit code, standard output and standard error, as of a wide terminal."""

    def run(*arguments, cwd, **environment):
        capsys.readouterr()
        with monkeypatch.context() as patch, warnings.catch_warnings():
            warnings.simplefilter("default")
            patch.chdir(cwd)
            patch.setattr(sys, "argv", ["foveasim", *arguments])
            patch.setattr(sys, "path", list(sys.path))
            for name, value in {"COLUMNS": "200", **environment}.items():
                patch.setenv(name, value)
            patch.setattr(cli, "console", PlainConsole())
            patch.setattr(cli, "error_console", PlainConsole(stderr=True))
            with pytest.raises(SystemExit) as ended:
                cli.main()
        printed = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, ended.value.code or 0, printed.out, printed.err)

    return run
