"""Command line: arguments to calls, exceptions to one line and an exit code; no logic."""

from __future__ import annotations

import json
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread, main_thread
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TextIO, cast

import typer

from foveasim import __version__
from foveasim._io.terminal import PlainConsole, as_plain_text, plain_streams, select_spinner
from foveasim.errors import FileError, FoveasimError, FoveasimWarning, printable

if TYPE_CHECKING:
    from rich.status import Status
    from rich.table import Table

    from foveasim.config import Result

__all__ = ["main"]

#: Exit code for invalid input.
BAD_INPUT = 2
#: Exit code for design-rule violations, failed points and trials.
FAILED = 1
#: Exit code after Ctrl-C, by the convention of shells: 128 + SIGINT.
INTERRUPTED = 130

app: typer.Typer = typer.Typer(
    help="Simulate image sensors with polygonal photosites.",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
console: PlainConsole = PlainConsole()
error_console: PlainConsole = PlainConsole(stderr=True)

KINDS = "shot, layout, rules, sweep, study or dataset"
#: Hint after an interruption that preserves results.
RESUME = "run the same command again to resume"
#: Period of the estimate of the remaining time, seconds.
SPEED_PERIOD_S = 3600.0
LAYOUT_HELP = "YAML, GDSII, OASIS, GeoJSON, GeoParquet or npz file, or the name of a bundled layout."
Out = Annotated[Path, typer.Option("--out", "-o", help="Directory for the results; created when missing.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", help="Replace a setting, for example sensor.bits=10; repeatable.")
]
Layers = Annotated[
    list[str] | None,
    typer.Option(
        "--layer",
        help="Layer of the photosites of a GDSII or OASIS file, 77/3, or of filters, filter_R=10/0; repeatable.",
    ),
]
Channels = Annotated[
    list[str] | None,
    typer.Option(
        "--channels", help="Layers of the filters of a GDSII or OASIS file, 10/0=R,11/0=G,12/0=B; repeatable."
    ),
]
Cell = Annotated[str | None, typer.Option("--cell", help="Cell of a GDSII or OASIS file.")]
Centre = Annotated[bool, typer.Option("--centre", help="Move the centre of the layout to the origin.")]
Reading = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Other options of a layout file: unit=mm, parts=split, invalid=skip, and of GDSII and OASIS duplicates=rename, "
        "missing=skip, circle_tolerance=1e-4; repeatable.",
    ),
]
FramesPerS = Annotated[float | None, typer.Option("--fps", help="Frame rate in frames per second.")]
Threads = Annotated[int | None, typer.Option("--threads", help="Number of threads; one per core by default.")]
Workers = Annotated[int | None, typer.Option("--workers", help="Number of worker processes; one per core by default.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a dask scheduler; local worker processes by default.")
]
Metrics = Annotated[
    list[str] | None,
    typer.Option("--metric", help="Additional metric: a name, or module:function, which is imported; repeatable."),
]


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Simulate image sensors with polygonal photosites."""
    if version:
        sys.stdout.write(f"foveasim {__version__}\n")
    elif context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")


@app.command()
def demo(out: Out = Path("out"), threads: Threads = None) -> None:
    """Simulate a foveal colour sensor and a four-zone sensor with a photograph as scene."""
    from foveasim.config import demo_settings, write_3d_picture

    foveal, *_ = _run(demo_settings(), [], out, threads)
    with _status("rendering in 3D"):
        path = write_3d_picture(foveal, out)
    if path is not None:
        _report(f"wrote {path}")


@app.command()
def run(
    settings: Annotated[Path, typer.Argument(help="YAML file of the shot.")],
    changes: Changes = None,
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    out: Out = Path("out"),
    threads: Threads = None,
    require: Annotated[
        bool, typer.Option("--require", help="Exit with 1 if a requirement of the settings is not met.")
    ] = False,
) -> None:
    """Simulate the shot of a settings file, and check its requirements."""
    if any(change.partition("=")[0].strip().startswith("gaze_path") for change in changes or []):
        _exit("error: --set gaze_path: only videos follow a path; use gaze_um, or foveasim video", BAD_INPUT)
    (result,) = _run(
        [settings], [*(changes or []), *_layout_changes(layer, channels, cell, centre, reading)], out, threads
    )
    if require and not result.shot.requirements:
        _exit(f"error: {settings}: contains no requirements", BAD_INPUT)
    if result.shot.requirements:
        from foveasim.explore import check_requirements

        found = check_requirements(result.shot, result.capture)
        for checked in found:
            console.print(as_plain_text(str(checked)))
        if require and not all(checked.is_met for checked in found):
            raise typer.Exit(FAILED)


@app.command()
def check(
    layout: Annotated[Path, typer.Argument(help=LAYOUT_HELP)],
    rules: Annotated[
        Path | None,
        typer.Option(
            "--rules",
            help="YAML file of design rules, or the name of a preset such as sky130_met1; by default the rules in LAYOUT.",
        ),
    ] = None,
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    report_file: Annotated[
        Path | None, typer.Option("--report", help="Write the violations to a KLayout report database (.lyrdb).")
    ] = None,
) -> None:
    """Check a layout against design rules; exit with 1 on violations."""
    from foveasim.config import read_any_layout, read_rules

    file = read_any_layout(layout, **_reading_options(layer, channels, cell, centre, reading))
    limits = file.rules if rules is None else read_rules(rules)
    if limits is None:
        _exit(f"error: {layout}: contains no design rules; specify them with --rules", BAD_INPUT)
    report = file.layout.check(limits)
    console.print(report)
    if report_file is not None:
        report.write(report_file)
        _report(f"wrote {report_file}")
    if not report.ok:
        raise typer.Exit(FAILED)


@app.command(name="compile")
def compile_(workers: Workers = None) -> None:
    """Compile all kernels for this machine, for example when a container is built."""
    from foveasim._core.jit import compile_kernels

    with _status("compiling kernels"):
        n_kernels = compile_kernels(n_workers=workers)
    console.print(f"compiled {n_kernels} kernels")


@app.command()
def layouts() -> None:
    """List the bundled layouts, by name, and the layout generators."""
    from rich.table import Table

    from foveasim._core.quantities import format_quantity
    from foveasim._io.yaml_files import first_comment
    from foveasim.config import bundled_layouts, read_layout_file
    from foveasim.layout import LAYOUTS
    from foveasim.layout.generator_registry import summary_of

    table = Table(box=None)
    for heading in ("name", "photosites", "field / µm", "site size / µm", "generator"):
        table.add_column(heading, justify="left" if heading in {"name", "generator"} else "right")
    descriptions = _described("name")
    with _status("reading layouts"):
        for name, path in bundled_layouts().items():
            descriptions.add_row(name, first_comment(path))
            found = read_layout_file(path).layout.describe()
            x0, y0, x1, y1 = found.bounds_um
            sizes = format_quantity([float(found.size_um[0]), float(found.size_um[-1])], "", digits=3)
            table.add_row(name, f"{found.n_sites:,}", f"{x1 - x0:.5g} x {y1 - y0:.5g}", sizes, found.origin)
    generators = _described("generator")
    for name, generator in sorted(LAYOUTS.items()):
        generators.add_row(name, summary_of(generator))
    console.print(table)
    for each in (descriptions, generators):
        console.print()
        console.print(each)


def _described(heading: str) -> Table:
    """Return an empty table of names and descriptions."""
    from rich.table import Table

    found = Table(box=None)
    found.add_column(heading, no_wrap=True)
    found.add_column("description")
    return found


@app.command()
def describe(
    layout: Annotated[Path, typer.Argument(help=LAYOUT_HELP)],
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    frames_per_s: FramesPerS = None,
    bits: Annotated[int, typer.Option("--bits", help="Bit depth of the codes.")] = 10,
    blanking: Annotated[float, typer.Option("--blanking", help="Blanking time over readout time.")] = 0.0,
    lanes: Annotated[int, typer.Option("--lanes", help="Number of output lanes.")] = 1,
) -> None:
    """Print counts, areas, site sizes, channels and, with --fps, the data rate of a layout."""
    from foveasim._io.yaml_files import first_comment
    from foveasim.config import bundled_layouts, read_any_layout
    from foveasim.layout import Readout

    readout = None
    if frames_per_s is not None:
        readout = Readout(frames_per_s=frames_per_s, bits=bits, blanking=blanking, n_lanes=lanes)
    found = read_any_layout(layout, **_reading_options(layer, channels, cell, centre, reading))
    if str(layout) in bundled_layouts() and not layout.exists():
        console.print(first_comment(bundled_layouts()[str(layout)]))
    console.print(found.layout.describe(readout))


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help=LAYOUT_HELP)],
    target: Annotated[
        Path, typer.Argument(help="File to write; the format by extension: .gds .oas .geojson .parquet .nxs .npz .svg.")
    ],
    layer: Annotated[
        list[str] | None,
        typer.Option("--layer", help="Layer of the photosites, 77/3, or of other shapes, filter_R=10/0; repeatable."),
    ] = None,
    layers: Annotated[
        Path | None, typer.Option("--layers", help="Layer map: YAML file of lines such as well: 20/0.")
    ] = None,
    source_layer: Annotated[
        list[str] | None,
        typer.Option(
            "--source-layer", help="Layer of the photosites in SOURCE, or with a name as for --layer; repeatable."
        ),
    ] = None,
    source_cell: Annotated[
        str | None, typer.Option("--source-cell", help="Cell of SOURCE, a GDSII or OASIS file.")
    ] = None,
    channels: Channels = None,
    centre: Centre = False,
    reading: Reading = None,
    dbu_um: Annotated[
        float | None, typer.Option("--dbu-um", help="Database unit of a GDSII or OASIS file in µm.")
    ] = None,
    max_vertices: Annotated[
        int | None,
        typer.Option(
            "--max-vertices", help="Maximum vertices of a polygon in a GDSII or OASIS file; others are divided."
        ),
    ] = None,
) -> None:
    """Convert a layout to another file format, and report rounding and dropped columns."""
    from foveasim.config import read_any_layout
    from foveasim.layout import write_layout
    from foveasim.layout.files import layer_options

    options = _reading_options(source_layer, channels, source_cell, centre, reading)
    layout = read_any_layout(source, **options).layout
    written = write_layout(
        layout, target, dbu_um=dbu_um, max_vertices=max_vertices, **layer_options(layer or [], layers)
    )
    dropped = f"; dropped columns: {', '.join(written.dropped_columns)}" if written.dropped_columns else ""
    _report(
        f"wrote {written.path}: {written.n_sites:,} photosites, vertices moved by at most "
        f"{written.max_displacement_um:.3g} µm, areas changed by at most {100 * written.worst_area_error:.3g} %{dropped}"
    )


@app.command()
def view(
    file: Annotated[
        Path,
        typer.Argument(
            help="File or name of a layout, a capture (.npz, .zarr), or a report of 'check' (.lyrdb, with --layout)."
        ),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the page to this .html file.")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve the page on localhost until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port for --serve; 0 for any free one.")] = 0,
    layout: Annotated[Path | None, typer.Option("--layout", help="Layout of the report.")] = None,
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    rules: Annotated[
        Path | None, typer.Option("--rules", help="Design rules to check: a YAML file or the name of a preset.")
    ] = None,
    solid: Annotated[
        bool,
        typer.Option("--solid", help="Show in 3D: columns of a capture, or wells and microlenses of a layout."),
    ] = False,
) -> None:
    """Show a layout, a capture or a report in a browser, on a page that works offline."""
    from foveasim._io.atomic import atomic_write
    from foveasim.config import read_viewable
    from foveasim.view.web import check_page_path, open_page, serve_page, solid_page, web_page

    if out is not None and serve:
        _exit("error: --out and --serve exclude each other; use one of them", BAD_INPUT)
    if port and not serve:
        _exit("error: --port requires --serve", BAD_INPUT)
    if out is not None:
        check_page_path(out)
    if solid and (rules is not None or layout is not None):
        _exit("error: --solid shows no violations; omit --rules and --layout", BAD_INPUT)
    with _status("reading"):
        options = _reading_options(layer, channels, cell, centre, reading)
        viewable = read_viewable(file, layout=layout, rules=rules, **options)
    with _status("writing the page"):
        flat = None if solid else web_page(viewable.data, report=viewable.report, name=viewable.name)
        text = solid_page(viewable.data, name=viewable.name) if flat is None else flat
    if out is not None:
        with atomic_write(out) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
        _report(f"wrote {out}")
        return
    if serve:
        serve_page(text, port=port, announce=lambda url: _print(f"serving {file} at {url} (press Ctrl-C to stop)"))
        return
    path, is_opened = open_page(text)
    _print(f"opened {path}" if is_opened else f"no browser found; open {path} in one")


@app.command()
def studio(
    shot: Annotated[Path | None, typer.Argument(help="YAML file of the shot; by default that of the demo.")] = None,
    changes: Changes = None,
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Directory for saved files; without it none are written.")
    ] = None,
    host: Annotated[
        str,
        typer.Option("--host", help="Address to serve at; others than 127.0.0.1 are accessible from other computers."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", help="Port; 0 for any free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")] = True,
) -> None:
    """Change the settings of a shot in the browser, with views that follow at once."""
    from foveasim.studio import run_studio

    announced: list[str] = []

    def announce(address: str, is_opened: bool) -> None:
        _print(f"studio at {address} (press Ctrl-C to stop)" if not announced else f"also at {address} ")
        announced.append(address)
        if browser and not is_opened and len(announced) == 1:
            _print("no browser found; open the address in one")

    changes = [*(changes or []), *_layout_changes(layer, channels, cell, centre, reading)]
    run_studio(shot, changes=changes, out=out, host=host, port=port, open_browser=browser, announce=announce)


@app.command()
def compare(
    files: Annotated[
        list[Path], typer.Argument(help="Two or more layouts, or settings files of shots. " + LAYOUT_HELP)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Write the report to this .html file.")] = Path(
        "comparison.html"
    ),
    budget: Annotated[
        str,
        typer.Option(
            "--budget", help="Budget that must be equal: n_sites, data_rate, readout_time, area, read_noise, or none."
        ),
    ] = "n_sites",
    tolerance: Annotated[float, typer.Option("--tolerance", help="Largest relative difference of the budgets.")] = 0.02,
    pictures: Annotated[
        list[Path] | None, typer.Option("--picture", help="Photograph to use as a scene; repeatable.")
    ] = None,
    layer: Layers = None,
    channels: Channels = None,
    cell: Cell = None,
    centre: Centre = False,
    reading: Reading = None,
    exposure_s: Annotated[float | None, typer.Option("--exposure-s", help="Exposure time in seconds.")] = None,
    frames_per_s: FramesPerS = None,
    max_pixels: Annotated[int, typer.Option("--pixels", help="Longer side of the pictures.")] = 256,
    annuli: Annotated[int, typer.Option("--annuli", help="Number of annuli around the optical axis.")] = 8,
    metrics: Annotated[list[str] | None, typer.Option("--metric", help="Name of a further metric; repeatable.")] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the noise.")] = 0,
) -> None:
    """Compare layouts or shots at equal budget, and write a report."""
    from foveasim.config import compare_files
    from foveasim.view.web import check_page_path

    check_page_path(out)
    with _progress("comparing", "nothing was written") as progress:
        found = compare_files(
            files,
            pictures=pictures or (),
            budget=None if budget == "none" else budget,
            tolerance=tolerance,
            exposure_s=exposure_s,
            layout_options=_reading_options(layer, channels, cell, centre, reading),
            frames_per_s=frames_per_s,
            max_pixels=max_pixels,
            n_annuli=annuli,
            metrics=metrics or (),
            seed=seed,
            progress=progress,
        )
        found.write(out)
    console.print(found)
    _report(f"wrote {out}")


@app.command()
def sweep(
    settings: Annotated[Path, typer.Argument(help="YAML file of the sweep: a shot, and the values of its settings.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Zarr store for the results; an interrupted sweep resumes from it.")
    ] = Path("results.zarr"),
    scheduler: Scheduler = None,
    workers: Workers = None,
    metrics: Metrics = None,
    retry: Annotated[bool, typer.Option("--retry", help="Repeat points that failed.")] = False,
) -> None:
    """Simulate a shot over a grid of settings; exit with 1 when a point failed."""
    from foveasim.explore import read_sweep, run_sweep

    plan = read_sweep(settings, metrics=metrics or ())
    with _progress(settings.stem, f"finished points are stored next to {out}, {RESUME}") as progress:
        results = run_sweep(plan, out=out, scheduler=scheduler, workers=workers, retry=retry, progress=progress)
    sizes = " x ".join(f"{n} {name}" for name, n in zip(plan.dims, plan.shape, strict=True))
    _report(f"wrote {out}: {plan.n_points:,} points ({sizes})")
    failed = [text for text in results["error"].to_numpy().ravel().tolist() if text]
    if failed:
        _exit(f"{len(failed):,} of {plan.n_points:,} points failed; the first: {failed[0]}", FAILED)


@app.command()
def plot(
    results: Annotated[Path, typer.Argument(help="Zarr store of a sweep.")] = Path("results.zarr"),
    metric: Annotated[str | None, typer.Option("--metric", help="Metric to draw; by default the first one.")] = None,
    x: Annotated[
        str | None, typer.Option("--x", help="Setting along x; by default the numeric one with the most values.")
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option("--at", help="Value of another setting, for example sensor.bits=10; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File of the figure, .png, .svg or .pdf; next to the store by default."),
    ] = None,
) -> None:
    """Draw a metric of a sweep against a setting."""
    from foveasim.explore import open_results
    from foveasim.view import hidden_figures, plot_results, save_figure

    selected = dict(part.partition("=")[::2] for part in at or ())
    with hidden_figures():
        axes = plot_results(open_results(results), metric, x=x, at=selected)
        target = results.with_suffix(".png") if out is None else out
        save_figure(axes.figure, target)  # type: ignore[arg-type]
    _report(f"wrote {target}")


@app.command()
def study(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the study: a shot, ranges of its settings, and objectives.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="SQLite file for the trials, by default study.db; an interrupted study resumes from it."
        ),
    ] = None,
    storage: Annotated[
        str | None, typer.Option("--storage", help="URL of an Optuna database, instead of --out.")
    ] = None,
    trials: Annotated[
        int | None, typer.Option("--trials", help="Total number of trials; by default that of the file.")
    ] = None,
    scheduler: Scheduler = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", help="Number of worker processes for batches of trials; this process by default."),
    ] = None,
    metrics: Metrics = None,
) -> None:
    """Optimise settings of a shot; exit with 1 when no trial satisfies the limits."""
    from foveasim.explore import best_table, finished_trials, read_study, run_study, storage_name

    if out is not None and storage is not None:
        _exit("error: --out and --storage exclude each other; use one of them", BAD_INPUT)
    if storage is not None and "://" not in storage:
        _exit(f"error: --storage must be a URL, such as sqlite:///study.db, got '{storage}'", BAD_INPUT)
    plan = read_study(settings, metrics=metrics or (), n_trials=trials)
    base = storage or str(out or "study.db")
    storage_label = storage_name(base)
    with _progress(settings.stem, f"finished trials are stored in {storage_label}, {RESUME}") as progress:
        found = run_study(plan, storage=base, scheduler=scheduler, workers=workers, progress=progress)
    finished = finished_trials(found)
    failed = [trial.user_attrs["error"] for trial in finished if "error" in trial.user_attrs]
    if failed:
        _report_error(f"{len(failed):,} of {len(finished):,} trials failed; the first: {failed[0]}")
    if not found.best_trials:
        reason = "all failed" if len(failed) == len(finished) else "all others violate the limits"
        _exit(f"no valid trial in {storage_label}: {reason}", FAILED)
    console.print(best_table(plan, found))
    _report(f"wrote {storage_label}: {len(finished):,} trials")


@app.command()
def dataset(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the dataset: pictures, a shot, and distributions of its settings.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Directory of tar shards, or a .zarr store; an interrupted dataset resumes from it."
        ),
    ] = Path("dataset"),
    scheduler: Scheduler = None,
    workers: Workers = None,
) -> None:
    """Simulate pictures with random camera settings, and write them as samples for learning."""
    from foveasim._core.threads import thread_count
    from foveasim.explore import read_dataset, write_dataset

    n_threads = 1 if workers is None else max(1, thread_count() // max(1, workers))
    with _status("reading pictures and settings"):
        file = read_dataset(settings, n_threads=n_threads)
    with _progress(settings.stem, f"finished shards are stored in {out}, {RESUME}") as progress:
        write_dataset(
            file.dataset, out, per_shard=file.per_shard, workers=workers, scheduler=scheduler, progress=progress
        )
    _report(f"wrote {out}: {len(file.dataset):,} samples")


@app.command()
def video(
    settings: Annotated[
        Path, typer.Argument(help="YAML file of the shot; its scene specifies size and radiance of the frames.")
    ],
    frames: Annotated[Path, typer.Option("--frames", help="Directory of pictures, or a video file.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A .zarr store with all codes, from which an interrupted video resumes; a .mp4, .webm, .gif or .webp file; or "
            "a directory for pictures.",
        ),
    ] = Path("video.zarr"),
    changes: Changes = None,
    frames_per_s: FramesPerS = None,
    line_s: Annotated[float, typer.Option("--line-s", help="Line time of a rolling shutter in seconds.")] = 0.0,
    scan: Annotated[
        str | None,
        typer.Option(
            "--scan",
            help="What a rolling shutter reads first in the picture, instead of the layout's readout_order: rows_from_top, "
            "rows_from_bottom, columns_from_left or columns_from_right.",
        ),
    ] = None,
    stop: Annotated[int | None, typer.Option("--stop", help="Maximum number of frames.")] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            "--times", help="CSV file of the times of the frames in the column t_s, instead of --fps or times_s."
        ),
    ] = None,
    gaze: Annotated[
        Path | None,
        typer.Option(
            "--gaze",
            help=(
                "CSV file of a gaze path with the columns t_s, x_um and y_um, or t_s, azimuth_deg and elevation_deg, instead "
                "of gaze_path, gaze_um or gaze_deg."
            ),
        ),
    ] = None,
    threads: Threads = None,
) -> None:
    """Simulate a video: the camera of a shot, with pictures or a video file as scenes."""
    from foveasim.config import read_shot, run_video
    from foveasim.video import count_recorded_frames, partial_path

    if frames_per_s is not None and not frames_per_s > 0.0:
        _exit(f"error: --fps must be > 0, got {frames_per_s:g}", BAD_INPUT)
    with _status("reading settings"):
        shot = read_shot(settings, changes or [], n_threads=threads)
    frame_s = None if frames_per_s is None else 1.0 / frames_per_s
    is_store = out.suffix.lower() == ".zarr"
    was_finished = is_store and out.exists()
    try:
        n = run_video(
            shot,
            frames,
            out,
            frame_s=frame_s,
            line_s=line_s,
            scan=cast("Any", scan),
            stop=stop,
            gaze=gaze,
            n_threads=threads,
            progress=True,
            times_s=times,
        )
    except KeyboardInterrupt:
        n = count_recorded_frames(out) if is_store and partial_path(out).is_dir() else 0
        stored = f"; {n:,} frames are stored next to {out}, {RESUME}" if n else ""
        _interrupt(f"interrupted{stored}")
    status = f"{out} was already complete" if was_finished else f"wrote {out}"
    _report(f"{status}: {n:,} frames")


@app.command()
def events(
    recording: Annotated[
        Path, typer.Argument(help="Events: .raw, .dat, .aedat4, .aedat, .h5, .npy, .npz, or .txt with lines t x y p.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .npz, .h5, .npy or .txt; without it, print a summary."),
    ] = None,
    layout: Annotated[Path | None, typer.Option("--layout", help=f"One site for each pixel: {LAYOUT_HELP}")] = None,
    pitch_um: Annotated[
        float | None, typer.Option("--pitch-um", help="Pixel pitch in µm, for a grid of the sensor size.")
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option("--time-unit", help="Unit of times in text: s, ms, us or ns.")
    ] = None,
    origin: Annotated[str, typer.Option("--origin", help="Time 0: file or first_event.")] = "file",
    ignore: Annotated[
        list[str] | None, typer.Option("--ignore", help="Unknown header or array that does not matter; repeatable.")
    ] = None,
) -> None:
    """Read events of an event camera, and write them on photosites."""
    from foveasim.config import read_any_layout
    from foveasim.modes import Events

    with _status("reading events"):
        found = Events.read(
            recording,
            None if layout is None else read_any_layout(layout).layout,
            pitch_um=pitch_um,
            time_unit=cast("Any", time_unit),
            origin=cast("Any", origin),
            ignore=ignore or (),
        )
    n_on = int((found.polarity > 0).sum())
    span = f", from {found.t_s[0]:.6f} to {found.t_s[-1]:.6f} s" if len(found) else ""
    _report(f"{len(found):,} events of {found.layout.n_sites:,} photosites, {n_on:,} of them ON{span}")
    if out is not None:
        found.save(out)
        _report(f"wrote {out}")


@app.command()
def twin(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of stacks of raw frames: subfolders such as dark_10ms and flat_10ms, or a file stacks.yaml."
        ),
    ],
    bits: Annotated[int, typer.Option("--bits", help="Bits of the codes.")],
    pixel_um: Annotated[float, typer.Option("--pixel-um", help="Side of a pixel in µm.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for twin.npz, report.html and figures.")] = Path(
        "twin"
    ),
    mosaic: Annotated[
        str | None, typer.Option("--mosaic", help="Colours of the first two rows: RGGB, BGGR, GRBG or GBRG.")
    ] = None,
    companding: Annotated[
        str, typer.Option("--companding", help="Transfer function of the ADC: linear, root or log.")
    ] = "linear",
    log_strength: Annotated[float, typer.Option("--log-strength", help="Strength of logarithmic companding.")] = 100.0,
) -> None:
    """Estimate the sensor of a camera from its dark and flat frames."""
    from foveasim._io.atomic import remove_directory
    from foveasim._io.resumable import disk_errors, partial_path
    from foveasim.twin import fit

    sums = partial_path(out)
    with _progress(folder.name, f"sums of finished stacks are stored in {sums}, {RESUME}") as progress:
        try:
            found = fit(
                folder,
                bits=bits,
                pixel_um=pixel_um,
                mosaic=cast("Any", mosaic),
                companding=cast("Any", companding),
                log_strength=log_strength,
                resume=sums,
                progress=progress,
            )
        except FoveasimError:
            remove_directory(sums)
            raise
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    paths = [out / "twin.npz", out / "report.html"]
    found.save(paths[0])
    found.write(paths[1])
    paths += found.write_figures(out)
    remove_directory(sums)
    table = _described("parameter")
    for row in found.records():
        value = row["note"] or f"{row['value']:.4g} ({row['low']:.4g} to {row['high']:.4g})"
        table.add_row(row["parameter"], value)
    console.print(table)
    _report("wrote " + ", ".join(map(str, paths)))


@app.command()
def schema(
    kind: Annotated[str, typer.Argument(help=f"Kind of file: {KINDS}.")] = "shot",
) -> None:
    """Print the JSON schema of a kind of settings file."""
    from foveasim.explore import schema_of

    sys.stdout.write(json.dumps(schema_of(kind), indent=2) + "\n")


@app.command()
def new(
    kind: Annotated[
        str, typer.Argument(help=f"Kind of file: {KINDS}; or sensor with --from-datasheet or --from-twin.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write, by default KIND.yaml in this directory.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    from_datasheet: Annotated[
        bool,
        typer.Option(
            "--from-datasheet", help="With the kind sensor: a data sheet, and a shot whose sensor has its values."
        ),
    ] = False,
    from_twin: Annotated[
        Path | None,
        typer.Option("--from-twin", help="With the kind sensor: twin.npz of a camera, and a shot with its sensor."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help="Quantity of the data sheet, for example dark_noise_e=5.56; repeatable."),
    ] = None,
) -> None:
    """Write a commented settings file to start from."""
    from foveasim.config import starting_command, write_starting_file

    if from_twin is not None and kind == "sensor" and not from_datasheet and not changes:
        from foveasim.config._new_sensor import write_shot_of_twin

        path = write_shot_of_twin(from_twin, out, force=force)
        _report(f"wrote {path}; next: {starting_command('shot', path)}")
        return
    if from_datasheet or kind == "sensor" or changes or from_twin is not None:
        _new_sensor(kind, out, changes or (), force=force, from_datasheet=from_datasheet)
        return
    path = write_starting_file(kind, out, force=force)
    _report(f"wrote {path}; next: {starting_command(kind, path)}")


def _new_sensor(kind: str, out: Path | None, changes: Sequence[str], *, force: bool, from_datasheet: bool) -> None:
    """Write the files of a sensor; without quantities, a terminal asks for them."""
    from foveasim.config import starting_command, write_sensor_files
    from foveasim.config._new_sensor import asked_quantities, quantities_of

    if kind != "sensor" or not from_datasheet:
        raise FoveasimError(
            "the kind sensor needs either --from-datasheet or --from-twin, of which only the former accepts --set: "
            "foveasim new sensor --from-datasheet"
        )
    if not changes and not sys.stdin.isatty():
        raise FoveasimError(
            "the quantities of the data sheet must be given as --set NAME=VALUE, or be typed in a terminal"
        )

    def ask(question: str) -> str:
        return str(typer.prompt(question, default="", show_default=False))

    quantities = quantities_of(changes) if changes else asked_quantities(ask, _report_error)
    sheet, shot = write_sensor_files(quantities, out, force=force)
    _report(f"wrote {sheet} and {shot}; next: {starting_command('shot', shot)}")


def _reading_options(
    layer: Sequence[str] | None,
    channels: Sequence[str] | None,
    cell: str | None,
    centre: bool,
    reading: Sequence[str] | None,
) -> dict[str, Any]:
    from foveasim.layout.files import reading_options

    return reading_options(layer=layer or (), channels=channels or (), cell=cell, centre=centre, further=reading or ())


def _layout_changes(
    layer: Sequence[str] | None,
    channels: Sequence[str] | None,
    cell: str | None,
    centre: bool,
    reading: Sequence[str] | None,
) -> list[str]:
    """Return the options as changes of the layout's settings."""
    options = _reading_options(layer, channels, cell, centre, reading)
    return [f"layout.{name}={json.dumps(value)}" for name, value in options.items()]


def _run(settings: Sequence[Path], changes: Sequence[str], out: Path, threads: int | None) -> list[Result]:
    from foveasim.config import check_directory, read_shot, results_table, run_shot

    check_directory(out)
    results = []
    written = []
    try:
        with _status("reading settings") as status:
            shots = [read_shot(path, changes, n_threads=threads) for path in settings]
            for shot in shots:
                status.update(
                    as_plain_text(f"{shot.name}: capturing with {shot.camera.sensor.layout.n_sites:,} photosites")
                )
                result, paths = run_shot(shot, out)
                results.append(result)
                written += paths
    except KeyboardInterrupt:
        _interrupt("interrupted")
    console.print(results_table(results))
    for path in written:
        _report(f"wrote {path}")
    return results


def main() -> None:
    """Run the command line; invalid input prints one line to standard error and exits with 2."""
    with plain_streams():
        _main()


def _main() -> None:
    show_warning = warnings.showwarning
    warnings.showwarning = _show_warning
    signals: list[int] = []

    def interrupt(number: int, _frame: Any) -> None:
        signals.append(number)
        raise KeyboardInterrupt

    handlers: dict[int, Any] = {}
    if current_thread() is main_thread():
        found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        # None is a handler that Python did not install, and cannot restore.
        handlers = {number: handler for number, handler in found.items() if handler not in (None, signal.SIG_IGN)}
    try:
        for number in handlers:
            signal.signal(number, interrupt)
        app()
    except (KeyboardInterrupt, SystemExit) as error:
        if not signals or (isinstance(error, SystemExit) and error.code != INTERRUPTED):
            raise
        if not isinstance(error, _Interrupted):
            _report_error("interrupted")
        # By convention 128 plus the number of the signal: 130 for Ctrl-C, 143 for SIGTERM.
        sys.exit(128 + signals[0])
    except FoveasimError as error:
        _exit("; ".join([f"error: {error}", *getattr(error, "__notes__", ())]), BAD_INPUT)
    except MemoryError:
        _exit("error: not enough memory; use a smaller picture or fewer photosites", BAD_INPUT)
    except OSError as error:
        reason = error.strerror or str(error)
        named = FileError(error.filename, reason) if isinstance(error.filename, str) else reason
        _exit(f"error: {named}", BAD_INPUT)
    finally:
        warnings.showwarning = show_warning
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def _progress(name: str, note: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar with the remaining time; Ctrl-C exits with a note."""
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
    # Parts of a long run may take minutes.
    progress = Progress(*columns, console=console, speed_estimate_period=SPEED_PERIOD_S)
    bar = progress.add_task(printable(name), total=None)

    def show(n_done: int, n: int) -> None:
        progress.start()  # at the first count, when workers are running
        progress.update(bar, completed=n_done, total=n)

    try:
        yield show
    except KeyboardInterrupt:
        _interrupt(f"interrupted; {note}")
    finally:
        if progress.live.is_started:
            progress.stop()


def _status(text: str) -> Status:
    """Show a line with a spinner, on terminals only."""
    return console.status(as_plain_text(text), spinner=select_spinner(console))


def _print(text: str) -> None:
    # Flushed: a program may read the address from a pipe.
    sys.stdout.write(printable(text) + "\n")
    sys.stdout.flush()


def _report(text: str) -> None:
    console.print(printable(text), soft_wrap=True)


def _report_error(text: str) -> None:
    error_console.print(printable(text), soft_wrap=True)


def _exit(text: str, code: int) -> NoReturn:
    _report_error(text)
    sys.exit(code)


class _Interrupted(SystemExit):
    """Exit after an interruption that was reported."""


def _interrupt(text: str) -> NoReturn:
    _report_error(text)
    raise _Interrupted(INTERRUPTED)


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
    error_console.print(printable(text) if is_ours else text, soft_wrap=True)


if __name__ == "__main__":
    main()
