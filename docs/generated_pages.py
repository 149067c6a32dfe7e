"""Pages that the build of the site writes: gallery, bundled layouts, reference."""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import pkgutil
import re
import runpy
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import numpy as np
import shapely
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from PIL import Image, ImageOps, ImageSequence
from skimage.color import rgb2gray
from skimage.data import astronaut

import foveasim.view
from foveasim import Integrator, PowerMap
from foveasim._core.quantities import format_quantity
from foveasim._core.registry import Registry
from foveasim._io.yaml_files import first_comment
from foveasim.config import bundled_layouts, read_layout_file
from foveasim.layout import LAYOUTS
from foveasim.scene import SCENES
from foveasim.sensor import PRESETS
from foveasim.view import plot_layout

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.config import Config

    from foveasim import Layout

REPOSITORY = Path(__file__).parent.parent
#: Pages of the gallery; pictures are generated again when a script is newer.
GALLERY = Path(__file__).parent / "gallery"
#: Pictures that are stored, such as those of scripts that require PyTorch.
PICTURES = Path(__file__).parent / "pictures"
#: Text instead of pictures where a script could not run.
WITHOUT_TORCH = "This site was built without PyTorch, which the script requires; the picture is from an earlier run."

#: Description of the module that only a build with PyTorch documents.
LEARN = "Gradients with respect to photosites, optics and electronics, for PyTorch."
#: Modules of the reference, with descriptions; their ``__all__`` lists the public names.
MODULES = {
    "foveasim": "The main classes, from scenes to captures: `import foveasim as fs`. The other modules are its attributes.",
    "foveasim.layout": "Layouts of photosites as packed polygons: generators, edits, design rules, files.",
    "foveasim.scene": "Scenes: radiance from photographs, hyperspectral cubes, displays, flat fields and point sources.",
    "foveasim.scene.charts": "Test charts with physical sizes.",
    "foveasim.scene.displays": "Bundled displays.",
    "foveasim.optics": "Pupils, aberrations, PSF, OTF, and the power map of a scene.",
    "foveasim.distortion": "Lens distortion models and calibration files.",
    "foveasim.maps": "Files of power maps from other programs.",
    "foveasim.sensor": "Quantum efficiency, colour filters, the electronic chain, noise budget, calibration, HDR merge.",
    "foveasim.sensor.effects": "Noise sources, fixed patterns and crosstalk, and the interface of user effects.",
    "foveasim.reconstruct": "Raster pictures from captures.",
    "foveasim.columns": "Columns of photosites: what tables, figures, pages and exports show of a capture.",
    "foveasim.tiles": "Captures of sensors that are larger than memory.",
    "foveasim.twin": "Real cameras: parameters from frames or events, real pictures beside simulated ones.",
    "foveasim.video": "Frames from files, gaze paths, recordings.",
    "foveasim.modes": "Rolling shutters, event pixels, integrate-and-fire pixels.",
    "foveasim.metrics": "Resolution, aliasing, photon transfer, signal-to-noise ratio, picture quality, optical flow.",
    "foveasim.compare": "Cameras and layouts at equal budget: pictures, quality by eccentricity, information, reports.",
    "foveasim.view": "Plots, 3D rendering, solids, and interactive pages.",
    "foveasim.explore": "Sweeps, optimisation studies and datasets.",
    "foveasim.config": "Settings files in YAML.",
    "foveasim.studio": "Interactive design in the browser.",
    **({"foveasim.learn": LEARN} if find_spec("torch") else {}),
    "foveasim.testing": "Checks of extensions.",
    "foveasim.errors": "Exceptions and warnings.",
    "foveasim.units": "Unit conversions.",
}
#: Headings of the names of large modules, by the module in which a name is defined; the rest is without heading.
GROUPS = {
    "foveasim.layout": {
        "Generators": ("foveasim.layout.generators", "foveasim.layout.diagrams"),
        "Edits": (
            "foveasim.layout.edits",
            "foveasim.layout.channels",
            "foveasim.layout.gaps",
        ),
        "Design rules": ("foveasim.layout.drc",),
        "Neighbours and readout": (
            "foveasim.layout.adjacency",
            "foveasim.layout.readout",
        ),
        "Files": ("foveasim.layout.files",),
    },
}
#: Functions that modules list by their registry.
REGISTERED = {
    "foveasim.layout": LAYOUTS.within("foveasim.layout.generators"),
    "foveasim.scene.charts": SCENES.within("foveasim.scene.charts"),
}
REFERENCE = Path(__file__).parent / "reference"
#: Pictures of pages: results of their code, figures of the reference, the home page.
RESULTS = Path(__file__).parent / "results"
FIGURES = RESULTS / "reference"
#: Sizes of the moving picture of the home page, and of the preview of links.
GAZE_PX, PREVIEW_PX = (400, 400), (1200, 630)
#: Pages of the bundled layouts.
BUNDLED = Path(__file__).parent / "layouts"
#: Photosites around the centre in the right part of their figures; differences of size below this are rounding.
N_NEAR, SAME_SIZE_UM = 150, 1e-6
#: Smallest and largest size of the scale of colours of all bundled layouts.
SIZES_UM = (0.5, 400.0)
#: Size of thumbnails of the gallery, and height over width of the part that they show.
THUMBNAIL_PX, TALLEST = (480, 360), 0.9
#: Chapters of the gallery, those of the guides, with the numbers of their scripts; others follow at the end.
CHAPTERS = {
    "First pictures": (1, 31, 26),
    "Design": (4, 12, 13, 14, 15, 16, 17),
    "Light": (32, 2, 3, 5, 37, 38, 6, 34, 7, 18, 39, 40),
    "Electronics": (9, 10, 8, 11, 20, 25, 33),
    "Measure": (19, 24),
    "Scale": (21, 22, 23),
    "Learn": (27, 28, 29, 30, 35, 36),
}


def public_names() -> dict[str, list[str]]:
    """List the public names of every module, which have a page each."""
    modules = {name: importlib.import_module(name) for name in MODULES}
    parts = {
        name: {m.name for m in pkgutil.iter_modules(getattr(module, "__path__", []))}
        for name, module in modules.items()
    }
    public = {}
    for name, module in modules.items():
        # Names that a package imports from its subpackages are listed there.
        hidden = {"__version__"}.union(
            *(
                other.__all__
                for at, other in modules.items()
                if at.startswith(f"{name}.")
            )
        )
        # Modules are not imported for this: foveasim.learn needs PyTorch.
        listed = dict.fromkeys([*module.__all__, *REGISTERED.get(name, {})])
        names = [n for n in listed if n not in hidden | parts[name]]
        public[name] = [n for n in names if not inspect.ismodule(getattr(module, n))]
    return public


def main_names(public: dict[str, list[str]]) -> list[str]:
    """List the names of ``foveasim`` that have their page in another module, in the order of the data flow."""
    top = importlib.import_module("foveasim")
    modules = {
        name: module
        for module, names in public.items()
        if module != "foveasim"
        for name in names
    }
    found = [f"{modules[name]}.{name}" for name in top.__all__ if name in modules]
    order = ["scene", "optics", "layout", "sensor", "reconstruct"]
    return sorted(
        found,
        key=lambda name: (
            *(k for k, part in enumerate(order) if f".{part}." in name),
            len(order),
            name,
        ),
    )


def gallery_scripts(repository: Path) -> list[Path]:
    """List the scripts of the gallery, which have a page each."""
    return sorted((repository / "gallery").glob("[0-9]*.py"))


def generated_pages(repository: Path) -> set[Path]:
    """List the pages and pictures that the build writes, relative to the directory of the documentation."""
    modules = {f"{name}.md" for name in MODULES}
    made = {
        f"made/{module}.{name}.rst"
        for module, names in public_names().items()
        for name in names
        if name not in tables_of(module, names) | constants_of(module, names)
    }
    scripts = {f"{script.stem}.md" for script in gallery_scripts(repository)}
    scripts |= {
        f"{script.stem}/{picture}"
        for script in gallery_scripts(repository)
        for picture in re.findall(r'"(\w+\.(?:png|webp))"', script.read_text())
    }
    layouts = {
        Path("layouts", page)
        for page in ("index.md", *(f"{name}.png" for name in bundled_layouts()))
    }
    home = {
        Path("results/home", picture) for picture in ("gaze.webp", "gaze_still.png")
    }
    reference = {Path("reference", page) for page in {"index.md"} | modules | made}
    validation = {path.stem for path in (repository / "validation").glob("*.py")}
    return (
        layouts
        | home
        | reference
        | {Path("validation", f"{stage}.md") for stage in {"index", *validation}}
        | {Path("gallery", page) for page in {"index.md"} | scripts}
    )


def tables_of(name: str, names: list[str]) -> dict[str, Mapping[Any, Any]]:
    """Return the registries and other mappings among the public names of a module."""
    module = importlib.import_module(name)
    return {
        n: getattr(module, n) for n in names if isinstance(getattr(module, n), Mapping)
    }


def constants_of(name: str, names: list[str]) -> dict[str, Any]:
    """Return the constants and types without a class among the names of a module."""
    module = importlib.import_module(name)
    values = {n: getattr(module, n) for n in names if n not in tables_of(name, names)}
    return {
        n: value
        for n, value in values.items()
        if not (inspect.isroutine(value) or inspect.isclass(value))
    }


def shown_value(value: object) -> str:
    """Return a constant, or the alternatives of a type, as Markdown in a table."""
    if get_origin(value) is Literal or isinstance(value, tuple):
        items = value if isinstance(value, tuple) else get_args(value)
        plain = [getattr(item, "name", item) for item in items]
        return ", ".join(f"`{item}`" for item in plain)
    return "function" if callable(value) else f"`{value}`"


def entry_of(value: object) -> str:
    """Return one line about an object in a mapping."""
    parts = [
        getattr(value, attribute, "")
        for attribute in ("title", "description", "definition")
    ]
    texts = [part for part in parts if isinstance(part, str) and part]
    if not texts and (inspect.isroutine(value) or inspect.isclass(value)):
        texts = [(inspect.getdoc(value) or "").partition("\n\n")[0]]
    if not texts:
        texts = [", ".join(map(str, value)) if isinstance(value, tuple) else str(value)]
    return plain_roles(": ".join(texts)).replace("|", "\\|")


def plain_roles(text: str) -> str:
    """Return reStructuredText of one paragraph as Markdown."""
    return (
        re.sub(r":\w+:`~?([^`]*)`", r"`\1`", text)
        .replace("``", "`")
        .replace("\n", " ")
        .strip()
    )


def comment_on(name: str, module: str) -> str:
    """Return the comment before the definition of a constant of a module, from the module that defines it."""
    home = REPOSITORY / module.replace(".", "/")
    single = home.with_suffix(".py")
    for path in [single] if single.exists() else sorted(home.rglob("*.py")):
        found = re.search(
            rf"((?:^#: .*\n)+){name}(?:: .*)? = ", path.read_text(), re.MULTILINE
        )
        if found:
            return plain_roles(re.sub(r"^#: ", "", found[1], flags=re.MULTILINE))
    return ""


def sections_of(name: str, names: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield headings, the first one empty, and names of a module."""
    groups = GROUPS.get(name, {})
    module = importlib.import_module(name)
    heading_of = {}
    for n in names:
        home = getattr(getattr(module, n), "__module__", "") or ""
        heading_of[n] = next(
            (heading for heading, homes in groups.items() if home.startswith(homes)), ""
        )
    for heading in ("", *groups):
        yield heading, [n for n in names if heading_of[n] == heading]


def write_reference(_app: Sphinx, _config: Config) -> None:
    """Write an index with descriptions, and a page with the public names of every module."""
    shutil.rmtree(REFERENCE, ignore_errors=True)  # pages of removed names
    REFERENCE.mkdir()
    public = public_names()
    for name, about in MODULES.items():
        tables = tables_of(name, public[name])
        constants = constants_of(name, public[name])
        page = [f"# {name}", about]
        if name == "foveasim":
            main = "\n".join(f"   ~{full_name}" for full_name in main_names(public))
            page.append(
                f"```{{eval-rst}}\n.. autosummary::\n   :nosignatures:\n\n{main}\n```"
            )
        for heading, names in sections_of(
            name, [n for n in public[name] if n not in tables | constants]
        ):
            if not names:
                continue
            rows = "\n".join(f"   {n}" for n in names)
            page.append(f"## {heading}" * bool(heading))
            page.append(
                f"```{{eval-rst}}\n.. currentmodule:: {name}\n\n.. autosummary::\n   :toctree: made\n   :nosignatures:\n\n"
                f"{rows}\n```"
            )
        for n, table in tables.items():
            kind = f"Registry: {table.kind}. " if isinstance(table, Registry) else ""
            rows = "\n".join(
                f"| `{key}` | {entry_of(value)} |" for key, value in table.items()
            )
            page.append(
                f"## {n}\n\n{kind}{comment_on(n, name)}\n\n| key | |\n|---|---|\n{rows}"
            )
        rows = "\n".join(
            f"| `{n}` | {shown_value(value)} | {comment_on(n, name)} |"
            for n, value in constants.items()
        )
        page.append(
            f"## Constants and types\n\n| name | value | |\n|---|---|---|\n{rows}"
            * bool(rows)
        )
        (REFERENCE / f"{name}.md").write_text("\n\n".join(filter(None, page)) + "\n")
    contents = "\n".join(MODULES)
    rows = "\n".join(
        f"| [{name}]({name}.md) | {about} | {len(public[name])} |"
        for name, about in MODULES.items()
    )
    table = f"| module | contents | public names |\n|---|---|---|\n{rows}"
    page_text = f"# Reference\n\n{table}\n\n```{{toctree}}\n:hidden:\n:maxdepth: 1\n\n{contents}\n```\n"
    (REFERENCE / "index.md").write_text(page_text)


def external_links() -> list[tuple[str, str]]:
    """Return names and addresses of the repository, none without a public address."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    address = settings["tool"]["foveasim"]["public-address"].rstrip("/")
    return [("Repository", address), ("Issues", f"{address}/issues")] if address else []


def write_home(_app: Sphinx, _config: Config) -> None:
    """Write the pictures of the home page, and that of links to the site."""
    for folder in ("home", "static"):
        (RESULTS / folder).mkdir(parents=True, exist_ok=True)
    source, moving = PICTURES / "31_moving_gaze.webp", RESULTS / "home" / "gaze.webp"
    if moving.exists() and moving.stat().st_mtime > source.stat().st_mtime:
        return
    with Image.open(PICTURES / "01_first_picture.png") as opened:
        preview = ImageOps.pad(opened.convert("RGB"), PREVIEW_PX, color="#14181d")
    preview.save(RESULTS / "static" / "preview.png")
    with Image.open(source) as opened:
        shots = [
            (frame.convert("RGB").resize(GAZE_PX), frame.info.get("duration", 160))
            for frame in ImageSequence.Iterator(opened)
        ]
    images, durations_ms = zip(*shots, strict=True)
    images[0].save(RESULTS / "home" / "gaze_still.png")
    encoded = io.BytesIO()
    images[0].save(
        encoded,
        "WEBP",
        save_all=True,
        append_images=images[1:],
        duration=durations_ms,
        loop=0,
        quality=55,
    )
    moving.write_bytes(encoded.getvalue())


def write_reference_figures(_app: Sphinx, _config: Config) -> None:
    """Draw the figures of the reference, again when their script is newer."""
    import reference_figures  # in this directory
    from dark_figures import with_dark_variants

    FIGURES.mkdir(parents=True, exist_ok=True)
    changed = Path(reference_figures.__file__).stat().st_mtime
    with with_dark_variants():
        for name, draw in reference_figures.figures():
            path = FIGURES / f"{name}.png"
            if not path.exists() or path.stat().st_mtime < changed:
                foveasim.view.save_figure(draw(), path, dpi=110)


def dotted_names(source: str) -> set[str]:
    """Return the complete names of everything that a script takes from foveasim."""
    tree = ast.parse(source)
    known: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            module = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            for name in node.names:
                if f"{module}{name.name}".startswith("foveasim"):
                    known[name.asname or name.name] = f"{module}{name.name}"
    for node in ast.walk(tree):  # make = fs.layout
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            target = chain_of(node.value)
            if target and target[0] in known:
                known[node.targets[0].id] = ".".join((known[target[0]], *target[1:]))
    chains = [chain_of(node) for node in ast.walk(tree)]
    return {
        ".".join((known[chain[0]], *chain[1:]))
        for chain in chains
        if chain and chain[0] in known
    }


def chain_of(node: ast.AST) -> tuple[str, ...]:
    """Return the names of ``a.b.c``, or none for other expressions."""
    if isinstance(node, ast.Name):
        return (node.id,)
    if isinstance(node, ast.Attribute) and chain_of(node.value):
        return (*chain_of(node.value), node.attr)
    return ()


def examples_of_names() -> dict[str, list[str]]:
    """Map the names that have a page to the pages of the gallery that use them."""
    homes = {}
    for module, names in public_names().items():
        for n in names:
            homes[id(getattr(importlib.import_module(module), n))] = f"{module}.{n}"
    found: dict[str, list[str]] = {}
    for script in gallery_scripts(REPOSITORY):
        used = set()
        for name in dotted_names(script.read_text()):
            value: Any = foveasim
            with suppress(AttributeError, ImportError):  # methods; PyTorch
                for part in name.split(".")[1:]:
                    value = getattr(value, part)
                    used.add(homes.get(id(value)))
        for name in used - {None}:
            found.setdefault(name, []).append(script.stem)
    return found


def write_layouts(_app: Sphinx, _config: Config) -> None:
    """Write a page with picture, figures and source of every bundled layout."""
    from dark_figures import with_dark_variants  # in this directory

    BUNDLED.mkdir(exist_ok=True)
    sections = []
    for name, path in bundled_layouts().items():
        picture = BUNDLED / f"{name}.png"
        layout = read_layout_file(path).layout
        if not picture.exists() or picture.stat().st_mtime < path.stat().st_mtime:
            with with_dark_variants():
                foveasim.view.save_figure(figure_of(layout), picture, dpi=140)
        source = " ".join(path.read_text().partition("source: >")[2].split())
        found = layout.describe()
        x0, y0, x1, y1 = found.bounds_um
        sizes = format_quantity(
            [float(found.size_um[0]), float(found.size_um[-1])], "µm", digits=3
        )
        figures = f"{found.n_sites:,} photosites of {sizes} in a field of {x1 - x0:,.5g} × {y1 - y0:,.5g} µm."
        title = first_comment(path)
        sections.append(
            f"## {name}\n\n{title} {figures}\n\n![{title}]({name}.png)\n\nSource: {source}"
        )
    about = (
        "Each name stands for a layout in every command, and in `fs.read_layout`: `foveasim view giotto_2`. The files are in "
        "`layouts/`, with design rules that they satisfy. Colours of sizes have one scale for all layouts; the "
        "photograph is the mean irradiance of each photosite, without noise."
    )
    (BUNDLED / "index.md").write_text(
        "\n\n".join(["# Bundled layouts", about, *sections]) + "\n"
    )


def write_published_sensors(_app: Sphinx, _config: Config) -> None:
    """Write the table of published sensors, which the guide of sensor parameters includes."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "published_sensors.txt").write_text(table_of_sensors() + "\n")


def table_of_sensors() -> str:
    """Return the presets of measured sensors as a table, with values as they are printed."""
    columns = {
        "pixel, µm": ("pixel_um",),
        "bits": ("bits",),
        "QE, %": ("qe_percent",),
        "dark noise, e-": ("dark_noise_e",),
        "saturation, e-": ("saturation_e", "full_well_e"),
    }
    rows = [["preset", *columns, "sensor and source"], ["---"] * (len(columns) + 2)]
    for name, preset in PRESETS.items():
        if preset.sheet is None:
            continue
        cells = [f"`{name}`"]
        for quantities in columns.values():
            printed = [preset.quantities.get(each) for each in quantities]
            cells.append(next((str(each) for each in printed if each is not None), ""))
        rows.append([*cells, f"{preset.title}. {preset.source}"])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def figure_of(layout: Layout) -> Figure:
    """Draw the sizes of photosites on the scale of all layouts, a photograph through them, and those around the centre."""
    figure = Figure(figsize=(8.0, 2.9), layout="constrained")
    sizes, seen, part = figure.subplots(1, 3)
    x0, y0, x1, y1 = layout.bounds_um
    centre_um = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    scale = ScalarMappable(LogNorm(*SIZES_UM), "viridis_r")
    size_colours = scale.to_rgba(layout.size_um)[:, :3]
    plot_layout(layout, size_colours, ax=sizes)
    bar = figure.colorbar(scale, ax=sizes, orientation="horizontal", label="size / µm")
    bar.ax.minorticks_off()
    bar.set_ticks([1, 10, 100], labels=["1", "10", "100"])
    side_um = max(x1 - x0, y1 - y0)
    face = rgb2gray(astronaut()[0:260, 95:355])[::-1]
    power_map = PowerMap.from_array(
        face, pitch_um=side_um / face.shape[0], wavelength_nm=550.0
    )
    moved = layout.translate(*-centre_um)
    mean = Integrator(moved, power_map.grid)(power_map.data)[0] / layout.area_um2
    plot_layout(
        layout,
        np.clip(mean, 0.0, 1.0)[:, np.newaxis].repeat(3, axis=1),
        ax=seen,
        scale_bar=False,
    )
    for axes in (sizes, seen):
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    offset_um = layout.centroid_um - centre_um
    radius_um = np.hypot(*offset_um.T)
    innermost = np.flatnonzero(radius_um < 1.01 * radius_um.min() + SAME_SIZE_UM)
    first = innermost[np.argmax(offset_um[innermost, 0])]
    if radius_um[first] > layout.size_um[first]:  # the edge of a blind spot
        centre_um = layout.centroid_um[first]
    distance_um = np.hypot(*(layout.centroid_um - centre_um).T)
    near = min(N_NEAR, layout.n_sites - 1)
    reach_um = np.partition(distance_um, near)[near]
    is_near = distance_um < 2.0 * reach_um
    if layout.channel.max() > 0:
        layout[is_near].plot("channel", ax=part, legend=False)
    else:
        plot_layout(layout[is_near], size_colours[is_near], ax=part)
        rings = shapely.get_rings(layout[is_near].polygons())
        part.add_collection(
            LineCollection(
                [shapely.get_coordinates(ring) for ring in rings],
                colors="0.2",
                linewidths=0.6,
            )
        )
    part.set_xlim(centre_um[0] - reach_um, centre_um[0] + reach_um)
    part.set_ylim(centre_um[1] - reach_um, centre_um[1] + reach_um)
    part.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for axes, title in (
        (sizes, "sizes"),
        (seen, "a photograph"),
        (part, "around the centre"),
    ):
        axes.set_title(title, fontsize=11)
    return figure


def write_thumbnail(picture: Path, thumbnail: Path) -> None:
    """Write a picture of 4:3: all of it on white, or its upper part if it is tall."""
    with Image.open(picture) as opened:
        image = opened.convert("RGBA")
    n_y = min(image.height, round(TALLEST * image.width))
    white = Image.new("RGBA", (image.width, n_y), "white")
    white.alpha_composite(image.crop((0, 0, image.width, n_y)))
    ImageOps.pad(white.convert("RGB"), THUMBNAIL_PX, color="white").save(
        thumbnail, quality=88
    )


def write_gallery(_app: Sphinx, _config: Config) -> None:
    """Run every script of the gallery; write a page with its question, pictures and source, and an index of cards."""
    from dark_figures import SUFFIX, with_dark_variants
    from gallery_pages import page_of, read_script

    cards: dict[int, str] = {}
    for script in gallery_scripts(REPOSITORY):
        folder = GALLERY / script.stem
        done = folder / "done"
        is_skipped = "import torch" in script.read_text() and not find_spec("torch")
        if not is_skipped and (
            not done.exists() or done.stat().st_mtime < script.stat().st_mtime
        ):
            folder.mkdir(parents=True, exist_ok=True)
            with with_dark_variants():
                runpy.run_path(str(script))["main"](folder)
            done.touch()
        title = script.stem[3:].replace("_", " ").capitalize()
        pictures = [
            f"{script.stem}/{picture.name}"
            for picture in sorted(folder.glob("*.*"))
            if picture.suffix in (".png", ".webp") and not picture.stem.endswith(SUFFIX)
        ]
        if is_skipped and not pictures:
            kept = sorted(PICTURES.glob(f"{script.stem[:2]}_*.png"))
            pictures = [
                f"../pictures/{picture.name}"
                for picture in kept
                if not picture.stem.endswith(SUFFIX)
            ]
            folder.mkdir(parents=True, exist_ok=True)
        page = page_of(script, title, pictures, WITHOUT_TORCH if is_skipped else "")
        (GALLERY / f"{script.stem}.md").write_text(page)
        question = read_script(script).question
        if pictures:
            write_thumbnail(GALLERY / pictures[0], folder / "thumbnail.jpg")
        thumbnail = (
            f":img-top: {script.stem}/thumbnail.jpg\n:img-alt: {title}\n"
            if pictures
            else ""
        )
        cards[int(script.stem[:2])] = (
            f":::{{grid-item-card}} {title}\n:link: {script.stem}\n:link-type: doc\n{thumbnail}\n{question}\n:::"
        )
    about = "Each script generates its pictures when the site is built, and checks its figures."
    listed = {number for numbers in CHAPTERS.values() for number in numbers}
    chapters = {
        **CHAPTERS,
        "More": tuple(number for number in cards if number not in listed),
    }
    stems = {
        int(script.stem[:2]): script.stem for script in gallery_scripts(REPOSITORY)
    }
    contents = "\n".join(
        stems[number] for numbers in chapters.values() for number in numbers
    )
    page = [f"# Gallery\n\n{about}\n\n```{{toctree}}\n:hidden:\n\n{contents}\n```"]
    for chapter, numbers in chapters.items():
        if numbers:
            page += [
                f"## {chapter}",
                "::::{grid} 1 2 3 3\n:gutter: 3",
                *(cards[number] for number in numbers),
                "::::",
            ]
    (GALLERY / "index.md").write_text("\n\n".join(page) + "\n")
