"""The command line: words to calls, errors to one sentence. No logic."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TextIO

import typer
from rich.console import Console

from foveasim import __version__
from foveasim.errors import FoveasimError, FoveasimWarning

__all__ = ["main"]

#: Exit code of a run that failed for what it was given.
BAD_INPUT = 2

app = typer.Typer(
    help="Simulates image sensors whose photosites are arbitrary polygons.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; made when it does not exist.")]
Threads = Annotated[int | None, typer.Option("--threads", help="Threads to use; all cores by default.")]


@app.command()
def demo(out: Out = Path("foveasim-demo"), threads: Threads = None) -> None:
    """Show a photograph to a foveal colour sensor and to a four-zone sensor."""
    from foveasim.shots import demo_settings

    _run(demo_settings(), [], out, threads)


@app.command()
def run(
    settings: Annotated[Path, typer.Argument(help="YAML file of the shot.")],
    changes: Annotated[list[str] | None, typer.Option("--set", help="Replace a setting: sensor.bits=10.")] = None,
    out: Out = Path("out"),
    threads: Threads = None,
) -> None:
    """Take the shot that a settings file describes."""
    _run([settings], changes or [], out, threads)


@app.command()
def schema() -> None:
    """Print the JSON schema of a settings file."""
    from foveasim.config import schema as json_schema

    sys.stdout.write(json.dumps(json_schema(), indent=2) + "\n")


@app.command()
def version() -> None:
    """Print the version."""
    sys.stdout.write(f"{__version__}\n")


def _run(settings: Sequence[Path], changes: Sequence[str], out: Path, threads: int | None) -> None:
    from foveasim.config import read_shot
    from foveasim.shots import results_table, take, write_results

    results = {}
    written = []
    with console.status("reading settings") as status:
        shots = [read_shot(path, changes, n_threads=threads) for path in settings]
        for shot in shots:
            status.update(f"{shot.name}: capturing with {shot.camera.sensor.layout.n_sites:,} photosites")
            capture = take(shot)
            status.update(f"{shot.name}: drawing and writing")
            paths, seconds = write_results(shot, capture, out)
            written += paths
            results[shot.name] = (capture, seconds)
    console.print(results_table(results))
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True, highlight=False)


def main() -> None:
    """Run the command line; bad input ends with one sentence and the exit code 2."""
    warnings.showwarning = _show_warning
    try:
        app(standalone_mode=True)
    except FoveasimError as error:
        errors.print(f"error: {error}", soft_wrap=True, highlight=False, markup=False)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        errors.print("stopped")
        sys.exit(130)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,  # noqa: ARG001 -- the signature is that of warnings.showwarning
    line: str | None = None,
) -> None:
    is_ours = issubclass(category, FoveasimWarning)
    text = f"warning: {message}" if is_ours else warnings.formatwarning(message, category, filename, lineno, line)
    errors.print(text, soft_wrap=True, highlight=False, markup=False)


if __name__ == "__main__":
    main()
