"""The program in a process of its own, as users run it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory


def run_program(*arguments, cwd, is_text=True, **environment):
    """Return exit code, standard output and standard error; ``environment``: further variables."""
    return subprocess.run(
        [sys.executable, "-m", "foveasim.cli", *arguments],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=is_text,
        check=False,
    )


#: Runs commands one after another, with files "0.out", "0.err", ... as their standard output and standard error.
ONE_BY_ONE = """
import json, os, sys, traceback

directory = sys.argv[1]
with open(os.path.join(directory, "commands.json")) as file:
    commands, before = json.load(file)
exec(before)
from foveasim.cli import main

codes = []
for k, arguments in enumerate(commands):
    for stream, suffix in ((sys.stdout, "out"), (sys.stderr, "err")):
        stream.flush()
        file = os.open(os.path.join(directory, f"{k}.{suffix}"), os.O_CREAT | os.O_WRONLY)
        os.dup2(file, stream.fileno())
        os.close(file)
    sys.argv = ["foveasim", *(os.fsdecode(bytes.fromhex(argument)) for argument in arguments)]
    try:
        main()
        codes.append(0)
    except SystemExit as error:
        codes.append(error.code or 0)
    except BaseException:
        traceback.print_exc()
        codes.append(1)
with open(os.path.join(directory, "codes.json"), "w") as file:
    json.dump(codes, file)
"""


def run_programs(*commands, cwd, before="", **environment):
    """
    Run commands one after another in one new process, which saves the start of an interpreter for each.

    ``before`` is code that runs first. Return exit code, standard output and standard error of each, as bytes.
    """
    with TemporaryDirectory() as name:
        directory = Path(name)
        encoded = [[os.fsencode(argument).hex() for argument in arguments] for arguments in commands]
        (directory / "commands.json").write_text(json.dumps([encoded, before]), encoding="ascii")
        subprocess.run([sys.executable, "-c", ONE_BY_ONE, name], cwd=cwd, env={**os.environ, **environment}, check=True)
        codes = json.loads((directory / "codes.json").read_text())
        return [
            subprocess.CompletedProcess(
                arguments, code, *((directory / f"{k}.{suffix}").read_bytes() for suffix in ("out", "err"))
            )
            for k, (arguments, code) in enumerate(zip(commands, codes, strict=True))
        ]
