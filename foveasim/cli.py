"""The command line: words to calls, errors to one text. No logic."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, TextIO

import typer

from foveasim import __version__
from foveasim._io.terminal import PlainConsole, plain_streams, spinner_of, text_of
from foveasim.errors import FileError, FoveasimError, FoveasimWarning, printable

if TYPE_CHECKING:
    from rich.status import Status

    from foveasim.config import Result

__all__ = ["main"]

#: Exit code of a run that failed for what it was given.
BAD_INPUT = 2
#: Exit code of a check that found a broken rule.
BROKEN_RULE = 1
#: Exit code of a run that the user stopped, as shells have it.
STOPPED = 130

app = typer.Typer(
    help="Simulates image sensors whose photosites are arbitrary polygons.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = PlainConsole()
console_of_errors = PlainConsole(stderr=True)

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; made when it does not exist.")]
Threads = Annotated[int | None, typer.Option("--threads", help="Threads to use; all cores by default.")]

Metrics = Annotated[
    list[str] | None,
    typer.Option("--metric", help="One more metric: a name, or module:function, which is imported and run."),
]


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    """Simulate image sensors whose photosites are arbitrary polygons."""
    if version:
        sys.stdout.write(f"foveasim {__version__}\n")
    elif context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")


@app.command()
def demo(out: Out = Path("out"), threads: Threads = None) -> None:
    """Show a photograph to a foveal colour sensor and to a four-zone sensor."""
    from foveasim.config import demo_settings, write_3d_picture

    foveal, *_ = _run(demo_settings(), [], out, threads)
    with _status("drawing in three dimensions"):
        path = write_3d_picture(foveal, out)
    if path is not None:
        _report(f"wrote {path}")


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
def check(
    layout: Annotated[
        Path, typer.Argument(help="YAML, GDSII, OASIS, GeoJSON, GeoParquet or npz file, or a shipped layout's name.")
    ],
    rules: Annotated[
        Path | None,
        typer.Option(
            "--rules",
            help="YAML file of rules, or a preset's name such as sky130_met1; by default the rules in LAYOUT.",
        ),
    ] = None,
    report_file: Annotated[Path | None, typer.Option("--report", help="Write the violations for KLayout.")] = None,
) -> None:
    """Check a layout against design rules; the exit code is 1 when one is broken."""
    from foveasim.config import read_any_layout, read_rules

    file = read_any_layout(layout)
    limits = file.rules if rules is None else read_rules(rules)
    if limits is None:
        _end(f"error: {layout}: holds no rules; name a file of rules with --rules", BAD_INPUT)
    report = file.layout.check(limits)
    console.print(report)
    if report_file is not None:
        report.write(report_file)
        _report(f"wrote {report_file}")
    if not report.ok:
        raise typer.Exit(BROKEN_RULE)


@app.command()
def layouts() -> None:
    """List the bundled layouts, whose names stand for their files in every command, and the layout families."""
    from rich.table import Table

    from foveasim.config import read_layout_file, shipped_layouts
    from foveasim.layout import LAYOUTS

    table = Table(box=None)
    for heading in ("name", "photosites", "field / µm", "pixel size / µm", "generator"):
        table.add_column(heading, justify="left" if heading in {"name", "generator"} else "right")
    with _status("reading layouts"):
        for name, path in shipped_layouts().items():
            found = read_layout_file(path).layout.describe()
            x0, y0, x1, y1 = found.bounds_um
            sizes = f"{found.size_um[0]:.3g} to {found.size_um[-1]:.3g}"
            table.add_row(name, f"{found.n_sites:,}", f"{x1 - x0:.5g} x {y1 - y0:.5g}", sizes, found.origin)
    console.print(table)
    families = Table(box=None)
    families.add_column("family")
    families.add_column("makes")
    for name, generator in sorted(LAYOUTS.items()):
        summary = (generator.__doc__ or "").strip().split("\n\n")[0].split(". ")[0]
        families.add_row(name, " ".join(summary.replace("``", "").split()).rstrip("."))
    console.print()
    console.print(families)


@app.command()
def describe(
    layout: Annotated[Path, typer.Argument(help="File of a layout, or the name of one that comes with the package.")],
    frames_per_s: Annotated[float | None, typer.Option("--fps", help="Frames per second, for the data rate.")] = None,
    bits: Annotated[int, typer.Option("--bits", help="Bits of a site's value.")] = 10,
    blanking: Annotated[float, typer.Option("--blanking", help="Time without data over time with data.")] = 0.0,
    lanes: Annotated[int, typer.Option("--lanes", help="Outputs that share the data.")] = 1,
) -> None:
    """Progress a layout's counts, areas, fill factor, pixel sizes, channels and data rate."""
    from foveasim.config import read_any_layout
    from foveasim.layout import Readout

    readout = None
    if frames_per_s is not None:
        readout = Readout(frames_per_s=frames_per_s, bits=bits, blanking=blanking, n_lanes=lanes)
    console.print(read_any_layout(layout).layout.describe(readout))


@app.command()
def convert(
    source: Annotated[
        Path, typer.Argument(help="YAML, GDSII, OASIS, GeoJSON, GeoParquet or npz file, or a shipped layout's name.")
    ],
    target: Annotated[Path, typer.Argument(help="Its ending names the format: .gds .oas .geojson .parquet .npz .svg")],
    layer: Annotated[int | None, typer.Option("--layer", help="Layer of the photosites in a chip file.")] = None,
    dbu_um: Annotated[
        float | None, typer.Option("--dbu-um", help="Database unit of a chip file to be written.")
    ] = None,
) -> None:
    """Write a layout in another format, and tell what was lost."""
    from foveasim.config import read_any_layout
    from foveasim.layout import write_layout

    written = write_layout(read_any_layout(source).layout, target, layer=layer, dbu_um=dbu_um)
    lost = f"; the format holds no {', '.join(written.dropped_columns)}" if written.dropped_columns else ""
    _report(
        f"wrote {written.path}: {written.n_sites:,} photosites, vertices moved by at most "
        f"{written.max_displacement_um:.3g} µm, areas changed by at most {100 * written.worst_area_error:.3g} %{lost}"
    )


@app.command()
def view(
    file: Annotated[
        Path,
        typer.Argument(
            help="A layout's file or name, a capture (.npz, .zarr), or a report of check (.lyrdb, with --layout)."
        ),
    ],
    web: Annotated[Path | None, typer.Option("--web", help="Write the page to this .html file.")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve the page on localhost until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of --serve; 0 for any that is free.")] = 0,
    layout: Annotated[Path | None, typer.Option("--layout", help="The layout that a report is of.")] = None,
    rules: Annotated[
        Path | None, typer.Option("--rules", help="Rules to check the layout against: a YAML file or a preset's name.")
    ] = None,
    solid: Annotated[
        bool,
        typer.Option("--solid", help="In three dimensions: a capture as columns, a layout with its wells and lenses."),
    ] = False,
) -> None:
    """Explore a layout, a capture or a report in a browser, on a page that needs no network."""
    from foveasim._io.atomic import atomic_write
    from foveasim.config import read_viewable
    from foveasim.view.web import check_page_path, open_page, serve_page, solid_page, web_page

    if web is not None and serve:
        _end("error: --web writes a file and --serve serves the page: take one of them", BAD_INPUT)
    if port and not serve:
        _end("error: --port belongs to --serve", BAD_INPUT)
    if web is not None:
        check_page_path(web)
    if solid and (rules is not None or layout is not None):
        _end("error: --solid shows no violations: leave --rules and --layout out", BAD_INPUT)
    with _status("reading"):
        seen = read_viewable(file, layout=layout, rules=rules)
    with _status("making the page"):
        flat = None if solid else web_page(seen.data, report=seen.report, name=seen.name)
        text = solid_page(seen.data, name=seen.name) if flat is None else flat
    if web is not None:
        with atomic_write(web) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
        _report(f"wrote {web}")
        return
    if serve:
        serve_page(text, port=port, announce=lambda at: _say(f"{file} is at {at} until you press Ctrl-C"))
        return
    path, is_opened = open_page(text)
    _say(f"opened {path}" if is_opened else f"found no browser; open {path} in one")


@app.command()
def sweep(
    settings: Annotated[Path, typer.Argument(help="YAML file of the sweep: a shot, and what varies in it.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Zarr folder for the results; a sweep that was ended goes on in it.")
    ] = Path("results.zarr"),
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="Address of a dask scheduler; by default processes of this machine."),
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", help="Those processes; one per core by default.")] = None,
    metrics: Metrics = None,
    retry: Annotated[bool, typer.Option("--retry", help="Try points again that failed before.")] = False,
) -> None:
    """Take a shot with many settings, and tabulate metrics; the exit code is 1 when a point failed."""
    from foveasim.explore import read_sweep, run_sweep

    plan = read_sweep(settings, metrics=metrics or ())
    with _progress(settings.stem, f"what is done is kept beside {out}") as progress:
        results = run_sweep(plan, out=out, scheduler=scheduler, workers=workers, retry=retry, progress=progress)
    sizes = " x ".join(f"{n} {name}" for name, n in zip(plan.dims, plan.shape, strict=True))
    _report(f"wrote {out}: {plan.n_points:,} points ({sizes})")
    failed = [text for text in results["error"].to_numpy().ravel().tolist() if text]
    if failed:
        _end(f"{len(failed):,} of {plan.n_points:,} points failed; the first: {failed[0]}", BROKEN_RULE)


@app.command()
def study(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the study: a shot, where its settings are searched, and what is best.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="SQLite file for the trials, study.db by default; a study that was ended goes on in it."
        ),
    ] = None,
    storage: Annotated[
        str | None, typer.Option("--storage", help="URL of a data base that Optuna takes, instead of --out.")
    ] = None,
    trials: Annotated[
        int | None, typer.Option("--trials", help="Trials that the study has at its end; by default the file's.")
    ] = None,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Address of a dask scheduler.")] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes for the trials of a batch; none but this by default.")
    ] = None,
    metrics: Metrics = None,
) -> None:
    """Search the settings that make a shot best; the exit code is 1 when no trial is good, failed or beyond the limits."""
    from foveasim.explore import best_table, finished_trials, read_study, run_study, storage_name

    if out is not None and storage is not None:
        _end("error: --out writes a file and --storage names a data base: take one of them", BAD_INPUT)
    if storage is not None and "://" not in storage:
        _end(f"error: --storage must be a URL, such as sqlite:///study.db, got '{storage}'", BAD_INPUT)
    plan = read_study(settings, metrics=metrics or (), n_trials=trials)
    base = storage or str(out or "study.db")
    place = storage_name(base)
    with _progress(settings.stem, f"the trials that are done are kept in {place}") as progress:
        found = run_study(plan, storage=base, scheduler=scheduler, workers=workers, progress=progress)
    done = finished_trials(found)
    failed = [trial.user_attrs["error"] for trial in done if "error" in trial.user_attrs]
    if failed:
        _tell(f"{len(failed):,} of {len(done):,} trials failed; the first: {failed[0]}")
    if not found.best_trials:
        why = "all failed" if len(failed) == len(done) else "those that did not fail are beyond the limits"
        _end(f"no trial in {place} is good: {why}", BROKEN_RULE)
    console.print(best_table(plan, found))
    _report(f"wrote {place}: {len(done):,} trials")


@app.command()
def dataset(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the dataset: pictures, a shot, and what is drawn of its settings.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="A folder of tar files, or a .zarr folder; a dataset that was ended goes on in it."
        ),
    ] = Path("dataset"),
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes; by default one per core, where there is enough to do.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="Address of a dask scheduler; by default processes of this machine."),
    ] = None,
) -> None:
    """Take pictures with cameras drawn at random, and write them as samples to learn from."""
    from foveasim._core.threads import thread_count
    from foveasim.explore import read_dataset, write_dataset

    n_threads = 1 if workers is None else max(1, thread_count() // max(1, workers))
    with _status("reading pictures and settings"):
        file = read_dataset(settings, n_threads=n_threads)
    with _progress(settings.stem, f"the shards that are done are kept in {out}") as progress:
        write_dataset(
            file.dataset, out, per_shard=file.per_shard, workers=workers, scheduler=scheduler, progress=progress
        )
    _report(f"wrote {out}: {len(file.dataset):,} samples")


@app.command()
def video(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the shot, whose scene's size and light the frames have.")
    ],
    frames: Annotated[Path, typer.Option("--frames", help="Folder of pictures, or a video file.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A .zarr folder with every code, in which a video that was ended goes on; a .mp4, .webm or .gif; or a "
            "folder of pictures.",
        ),
    ] = Path("video.zarr"),
    changes: Annotated[list[str] | None, typer.Option("--set", help="Replace a setting: sensor.bits=10.")] = None,
    frames_per_s: Annotated[
        float | None, typer.Option("--fps", help="Frames per second of a folder of pictures.")
    ] = None,
    line_s: Annotated[float, typer.Option("--line-s", help="Rolling shutter: seconds from line to line.")] = 0.0,
    stop: Annotated[int | None, typer.Option("--stop", help="Frames to take, at most.")] = None,
    threads: Threads = None,
) -> None:
    """Take a video with the camera of a settings file: pictures or a video file instead of its scene."""
    from foveasim.config import read_shot, run_video
    from foveasim.video import count_recorded_frames, partial_path

    if frames_per_s is not None and not frames_per_s > 0.0:
        _end(f"error: --fps must be > 0, got {frames_per_s:g}", BAD_INPUT)
    with _status("reading settings"):
        shot = read_shot(settings, changes or [], n_threads=threads)
    frame_s = None if frames_per_s is None else 1.0 / frames_per_s
    is_kept = out.suffix.lower() == ".zarr"
    was_finished = is_kept and out.exists()
    try:
        n = run_video(shot, frames, out, frame_s=frame_s, line_s=line_s, stop=stop, n_threads=threads, progress=True)
    except KeyboardInterrupt:
        n = count_recorded_frames(out) if is_kept and partial_path(out).is_dir() else 0
        kept = f"; {n:,} frames are kept beside {out}, and the same command goes on from there" if n else ""
        _end(f"stopped{kept}", STOPPED)
    told = f"{out} was finished before" if was_finished else f"wrote {out}"
    _report(f"{told}: {n:,} frames")


@app.command()
def schema(
    kind: Annotated[str, typer.Argument(help="What the file describes: shot, sweep, study or dataset.")] = "shot",
) -> None:
    """Print the JSON schema of a settings file: of a shot, or of many."""
    from foveasim.explore import schema_of

    sys.stdout.write(json.dumps(schema_of(kind), indent=2) + "\n")


def _run(settings: Sequence[Path], changes: Sequence[str], out: Path, threads: int | None) -> list[Result]:
    from foveasim.config import check_folder, read_shot, results_table, run_shot

    check_folder(out)
    results = []
    written = []
    try:
        with _status("reading settings") as status:
            shots = [read_shot(path, changes, n_threads=threads) for path in settings]
            for shot in shots:
                status.update(text_of(f"{shot.name}: capturing with {shot.camera.sensor.layout.n_sites:,} photosites"))
                result, paths = run_shot(shot, out)
                results.append(result)
                written += paths
    except KeyboardInterrupt:
        _end("stopped", STOPPED)
    console.print(results_table(results))
    for path in written:
        _report(f"wrote {path}")
    return results


def main() -> None:
    """Run the command line; bad input ends with one line on standard error and the exit code 2."""
    with plain_streams():
        _main()


def _main() -> None:
    show_warning = warnings.showwarning
    warnings.showwarning = _show_warning
    try:
        app()
    except FoveasimError as error:
        _end("; ".join([f"error: {error}", *getattr(error, "__notes__", ())]), BAD_INPUT)
    except MemoryError:
        _end("error: there is not enough memory for this; take a smaller picture or fewer photosites", BAD_INPUT)
    except OSError as error:
        reason = error.strerror or str(error)
        named = FileError(error.filename, reason) if isinstance(error.filename, str) else reason
        _end(f"error: {named}", BAD_INPUT)
    finally:
        warnings.showwarning = show_warning


@contextmanager
def _progress(name: str, kept: str) -> Iterator[Callable[[int, int], None]]:
    """A bar with the time left, from the first count on; Ctrl-C ends with what is kept, and how to go on."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    description = TextColumn("{task.description}", markup=False)
    columns = (description, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    progress = Progress(*columns, console=console)
    bar = progress.add_task(printable(name), total=None)

    def show(n_done: int, n: int) -> None:
        progress.start()  # now that there are workers
        progress.update(bar, completed=n_done, total=n)

    try:
        yield show
    except KeyboardInterrupt:
        _end(f"stopped; {kept}, and the same command goes on from there", STOPPED)
    finally:
        if progress.live.is_started:
            progress.stop()


def _status(text: str) -> Status:
    """A line with a spinner, on terminals only."""
    return console.status(text_of(text), spinner=spinner_of(console))


def _say(text: str) -> None:
    # Flushed: who waits for an address may read it from a pipe.
    sys.stdout.write(printable(text) + "\n")
    sys.stdout.flush()


def _report(text: str) -> None:
    console.print(printable(text), soft_wrap=True)


def _tell(text: str) -> None:
    console_of_errors.print(printable(text), soft_wrap=True)


def _end(text: str, code: int) -> NoReturn:
    _tell(text)
    sys.exit(code)


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
    console_of_errors.print(printable(text) if is_ours else text, soft_wrap=True)


if __name__ == "__main__":
    main()
