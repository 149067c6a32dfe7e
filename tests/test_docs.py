"""Documentation: code of every page runs, links have targets, the table of sensor parameters is complete."""

from __future__ import annotations

import ast
import re
import runpy
import sys
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from PIL import Image
from registries import restored

import foveasim
from foveasim._core.registry import Registry
from foveasim.sensor import Sensor

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
#: Targets of links and pictures, without URLs and sections of the same page.
TARGET = re.compile(r"\]\((?![a-z]+:)([^)#\s]+)")
#: Directories that the build writes.
GENERATED = {"_build", "gallery", "layouts", "reference", "results", "validation"}


def pages_of(root):
    """Return the written pages of a repository."""
    docs = root / "docs"
    return [page for page in sorted(docs.rglob("*.md")) if page.relative_to(docs).parts[0] not in GENERATED]


@cache
def names_of(script):
    """Return the names of a script in the documentation."""
    return runpy.run_path(str(ROOT / "docs" / script))


def broken_links(root):
    """Yield page and target of links to neither files of the repository nor generated pages."""
    docs = root.resolve() / "docs"
    generated = names_of("generated_pages.py")["generated_pages"](root)
    top = [root / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md") if (root / name).exists()]
    for page in [*top, *pages_of(root)]:
        for target in TARGET.findall(page.read_text()):
            path = (page.parent / target).resolve()
            below = path.relative_to(docs) if path.is_relative_to(docs) else None
            if below in generated:
                continue
            # Files of an earlier build may be outdated.
            if not path.exists() or (below is not None and below.parts[:1] and below.parts[0] in GENERATED):
                yield str(page.relative_to(root)), target


PAGES = [page for page in [ROOT / "README.md", *pages_of(ROOT)] if BLOCK.search(page.read_text())]


#: Requirements of the code of pages.
NEEDS = {
    "learning": [pytest.mark.needs("torch")],
    "learning_networks": [pytest.mark.needs("torch")],
    "viewing": [pytest.mark.needs("renderer")],
}


#: Numbers in the code of pages, by what the tests compute with instead, where the page only takes longer with more.
SMALLER = {
    "cheat_sheet": {"n_sites=4096": "n_sites=1024"},
    "comparing": {"n_sites=4096": "n_sites=961"},
    "tutorial": {"n_sites=4096": "n_sites=1024"},
    "layouts": {"n_sites=14_000": "n_sites=1369"},
    "layout_files": {"640": "64", "480": "48"},
}


def code_of(page):
    """Return the blocks of code of a page."""
    blocks = BLOCK.findall(page.read_text())
    for number, smaller in SMALLER.get(page.stem, {}).items():
        assert any(number in block for block in blocks)
        blocks = [block.replace(number, smaller) for block in blocks]
    return blocks


@pytest.fixture
def _registries_stay():
    """Restore the registries after a page."""
    modules = [module for name, module in sys.modules.items() if name.startswith("foveasim")]
    found = [item for module in modules for item in vars(module).values() if issubclass(type(item), Registry)]
    with restored(*{id(registry): registry for registry in found}.values()):
        yield


@pytest.mark.nightly
@pytest.mark.slow(keep=("README", "quick_start"))
@pytest.mark.usefixtures("_registries_stay")
@pytest.mark.parametrize("page", [pytest.param(page, marks=NEEDS.get(page.stem, []), id=page.stem) for page in PAGES])
def test_code_on_a_page_runs(page, tmp_path, monkeypatch):
    import matplotlib as mpl
    from skimage.data import astronaut

    mpl.use("agg")
    monkeypatch.chdir(tmp_path)
    Image.fromarray(astronaut()).save("photo.jpg")
    monkeypatch.setitem(sys.modules, "__main__", main := ModuleType("__main__"))  # whose classes can be pickled
    for block in code_of(page):
        exec(compile(block, str(page), "exec"), vars(main))


def test_citation_agrees_with_its_file():
    page = " ".join((ROOT / "docs" / "citing.md").read_text().split())
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())

    assert page.count(cited["references"][0]["title"]) == 2  # the text and BibTeX
    assert f"title = {{{cited['title']}}}" in page
    assert f"version = {{{cited['version']}}}" in page
    assert cited["version"] == foveasim.__version__


def test_each_extension_takes_30_lines():
    pages = [ROOT / "docs" / "extending.md", *(ROOT / "docs" / "extending").glob("*.md")]
    blocks = [block for page in pages for block in BLOCK.findall(page.read_text())]

    assert len(blocks) >= 6
    assert max(block.count("\n") for block in blocks) <= 30


def test_links_lead_to_pages():
    assert list(broken_links(ROOT)) == []


def test_tables_have_header_rows():
    wrong = []
    for page in pages_of(ROOT):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        tables = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)
        wrong += [(page.stem, table) for table in tables if not re.match(r"\|.*\n\|[\s:|-]+\n", table)]

    assert wrong == []


#: Columns of code for which the site has room.
MAX_COLUMNS = 88
FENCE = re.compile(r"^(`{3,})([^\n]*)\n(.*?)^\1 *$", re.MULTILINE | re.DOTALL)


def lines_of_code(text):
    """Return the lines in fenced and indented blocks of a Markdown page."""
    fenced = [line for block in FENCE.findall(text) for line in block[2].split("\n")]
    return fenced + [line for line in FENCE.sub("", text).split("\n") if re.match(r" {4}(?! *[*|-] )", line)]


@pytest.mark.parametrize(
    ("text", "n_wide"),
    [
        (f"```python\n{'x' * 89}\n```\n", 1),
        (f"a\n\n    {'x' * 85}\n", 1),
        (f"```text\n{'x' * 88}\n```\n{'x' * 120}\n", 0),
    ],
)
def test_wide_lines_of_code_are_found(text, n_wide):
    assert sum(len(line) > MAX_COLUMNS for line in lines_of_code(text)) == n_wide


def test_lines_of_code_fit_the_pages():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages_of(ROOT)]
    wide = [(page.name, line) for page in pages for line in lines_of_code(page.read_text()) if len(line) > MAX_COLUMNS]
    scripts = sorted((ROOT / "gallery").glob("*.py"))
    wide += [(path.name, line) for path in scripts for line in path.read_text().split("\n") if len(line) > MAX_COLUMNS]

    assert wide == []


def test_all_pages_are_found():
    assert len(pages_of(ROOT)) >= 19
    assert len(PAGES) >= 13
    assert sum(len(TARGET.findall(page.read_text())) for page in pages_of(ROOT)) >= 25


@pytest.mark.parametrize(
    ("target", "answer"),
    [
        ("validation/index.md", ""),
        ("benchmarks.md", "| reference | ratio |"),
        ("guides/sensors.md#presets", '"machine_vision"'),
        ("extending/own_effects.md", "EFFECTS.register"),
        ("citing.md", "@software{foveasim"),
    ],
)
def test_first_page_leads_to_answers(target, answer):
    """How accurate and how fast it is, which sensors it contains, how to add a noise source, and how to cite it."""
    docs = ROOT / "docs"
    name = target.partition("#")[0]

    assert f"]({target})" in (docs / "index.md").read_text("utf-8")
    assert Path(name) in names_of("generated_pages.py")["generated_pages"](ROOT) or answer in (docs / name).read_text(
        "utf-8"
    )


def write_repository(root, links):
    """Write two pages and one gallery script, in a directory with the name of a generated one."""
    for folder in ("docs/guides", "docs/gallery", "gallery"):
        (root / folder).mkdir(parents=True)
    (root / "gallery" / "01_edges.py").write_text('save(out_dir / "01_edges.png")')
    (root / "docs" / "gallery" / "02_removed.md").write_text("[](../nowhere.md)")
    (root / "README.md").write_text("[](docs/index.md)")
    (root / "docs" / "index.md").write_text("[](guides/a.md) [](https://example.org/a.md) [](#section)")
    (root / "docs" / "guides" / "a.md").write_text("\n".join(f"[see]({link})" for link in links))


@pytest.mark.parametrize(
    "link",
    [
        "../index.md",
        "a.md#section",
        "../gallery/index.md",
        "../gallery/01_edges.md",
        "../gallery/01_edges/01_edges.png",
        "../reference/index.md",
        "../reference/foveasim.layout.md",
        "../reference/made/foveasim.layout.hexagonal.rst",
    ],
)
def test_good_link_is_accepted(tmp_path, link):
    write_repository(tmp_path / "gallery", [link])

    assert list(broken_links(tmp_path / "gallery")) == []


@pytest.mark.parametrize(
    "link",
    [
        "b.md",
        "../pictures/a.png",
        "../gallery/01_corners.md",
        "../gallery/01_edges/01_corners.png",
        "../gallery/02_removed.md",
        "../gallery/made/01_edges.md",
        "../reference/foveasim.nothing.md",
        "../reference/made/foveasim.layout.nothing.rst",
        "../_build/html/index.html",
    ],
)
def test_broken_link_is_reported(tmp_path, link):
    write_repository(tmp_path / "gallery", [link])

    assert list(broken_links(tmp_path / "gallery")) == [("docs/guides/a.md", link)]


@pytest.fixture
def generators():
    return names_of("generated_pages.py")


@pytest.fixture
def dark():
    return names_of("dark_figures.py")


def test_chapters_of_gallery_contain_each_script_once(generators):
    numbers = sorted(number for numbers in generators["CHAPTERS"].values() for number in numbers)

    assert numbers == [int(script.name[:2]) for script in generators["gallery_scripts"](ROOT)]


def test_registries_are_described_by_their_entries(generators):
    tables = generators["tables_of"]("foveasim.layout", ["LAYOUTS", "RULES", "grid"])
    lines = {name: generators["entry_of"](next(iter(table.values()))) for name, table in tables.items()}

    assert set(tables) == {"LAYOUTS", "RULES"}
    assert all(len(line) > 20 and "\n" not in line for line in lines.values())
    assert generators["comment_on"]("LAYOUTS", "foveasim.layout").startswith("Layout generators by their name")


def test_table_of_sensors_has_their_sources(generators):
    lines = generators["table_of_sensors"]().splitlines()
    published = {name: preset for name, preset in foveasim.sensor.PRESETS.items() if preset.group != "paper"}

    assert len(lines) == 2 + len(published)
    for line, (name, preset) in zip(lines[2:], published.items(), strict=True):
        assert line.startswith(f"| `{name}` | {preset.quantities['pixel_um']} | ")
        assert preset.source in line
        assert line.count(" | ") == 6


def test_constants_are_described(generators):
    public = generators["public_names"]()
    comments = {
        f"{module}.{name}": generators["comment_on"](name, module)
        for module, names in public.items()
        for name in generators["constants_of"](module, names)
    }

    assert {"foveasim.units.PLANCK_J_S", "foveasim.sensor.FIXED", "foveasim.optics.Pupil"} <= set(comments)
    assert [name for name, comment in comments.items() if not comment] == []


def test_used_names_of_a_script_are_complete(generators):
    script = """
import numpy as np
import foveasim as fs
from foveasim.view import plot_layout as draw
make = fs.layout
draw(make.zones(side_um=9).translate(1.0, 2.0))
axes.grid()
np.split(fs.Scene.from_picture("a.png"), 2)
"""
    names = generators["dotted_names"](script)

    assert {"foveasim.layout.zones", "foveasim.view.plot_layout", "foveasim.Scene.from_picture"} <= names
    assert not any(name.endswith(("grid", "split")) for name in names)


@pytest.fixture
def session(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    found = names_of("code_results.py")["Session"](str(tmp_path / "results"))
    yield found
    found.close()


def test_results_are_lines_and_last_value(session):
    printed, pictures = session.run("print('a')\nb = 3\nb + 1", "python")

    assert (printed, pictures) == ("a\n4", [])
    assert session.run("print(b)\nb = 5", "python") == ("3", [])


def test_written_pictures_are_results(session):
    code = "from PIL import Image\nwith Image.open('photo.jpg') as photo:\n    photo.resize((8, 4)).save('small.png')"
    printed, pictures = session.run(code, "python")

    assert printed == ""
    (picture,) = pictures
    with Image.open(picture) as small:
        assert small.size == (8, 4)
    assert session.run("1 + 1", "python") == ("2", [])


def test_figures_are_results_in_light_and_dark(session, dark):
    code = "from matplotlib.figure import Figure\nFigure(figsize=(1.0, 1.0)).add_subplot()"
    _, (picture,) = session.run(code, "python")
    light, inverted = (
        Image.open(path).convert("RGB").getpixel((0, 0)) for path in (picture, dark["dark_path"](picture))
    )

    assert light == (255, 255, 255)
    assert max(inverted) < 30


def test_long_results_are_wrapped_and_cut(session):
    shown = list(names_of("code_results.py")["shown_lines"]("a " * 60 + "\n" + "b\n" * 50))

    assert max(map(len, shown)) <= MAX_COLUMNS
    assert (shown.count("b"), shown[-1]) == (29, "…")


def test_functions_of_layout_are_in_groups(generators):
    names = generators["public_names"]()["foveasim.layout"]
    groups = dict(generators["sections_of"]("foveasim.layout", names))

    assert sorted(name for group in groups.values() for name in group) == sorted(names)
    assert {"grid", "log_polar"} <= set(groups["Generators"])
    assert {"clip", "mosaic"} <= set(groups["Edits"])


def test_dark_variant_inverts_greys_and_is_reverted(dark):
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.add_subplot()
    (black, red) = (axes.plot([0, 1], color=colour)[0] for colour in ("black", "red"))
    text = axes.annotate("a", (0, 0), (0.5, 0.5), bbox={"facecolor": "white"}, arrowprops={"arrowstyle": "->"})
    image = axes.imshow([[0.0, 1.0]], cmap="gray")
    restore = dark["invert_greys"](figure)

    assert [to_rgb(colour) for colour in (black.get_color(), text.get_color(), axes.xaxis.label.get_color())] == [
        (dark["BLACK"],) * 3
    ] * 3
    for patch in (figure.patch, axes.patch, text.get_bbox_patch()):
        assert to_rgb(patch.get_facecolor()) == pytest.approx((dark["WHITE"],) * 3)
    assert red.get_color() == "red"
    assert image.get_cmap().name == "gray"

    for set_value, value in reversed(restore):
        set_value(value)
    assert black.get_color() == "black"
    assert to_rgb(figure.patch.get_facecolor()) == (1.0, 1.0, 1.0)


def test_markers_have_inverted_greys(dark):
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    figure = Figure()
    (points,) = figure.add_subplot().plot([0, 1], "ko")
    dark["invert_greys"](figure)

    assert to_rgb(points.get_markerfacecolor()) == to_rgb(points.get_markeredgecolor()) == (dark["BLACK"],) * 3


def test_greys_of_dark_figures_remain(dark):
    from matplotlib.figure import Figure

    figure = Figure(facecolor="#101418")
    title = figure.suptitle("a", color="white")

    assert dark["invert_greys"](figure) == []
    assert title.get_color() == "white"


@pytest.mark.parametrize("size", [(300, 100), (100, 300), (640, 480)])
def test_thumbnails_have_one_shape(tmp_path, size, generators):
    Image.new("RGBA", size, (200, 0, 0, 128)).save(tmp_path / "picture.png")
    generators["write_thumbnail"](tmp_path / "picture.png", tmp_path / "thumbnail.jpg")

    with Image.open(tmp_path / "thumbnail.jpg") as thumbnail:
        assert thumbnail.size == (480, 360)


ROW = re.compile(r"^\| `(\w+)` \|[^|]*\| `([^`]*)` \|", re.MULTILINE)


def test_parameter_table_lists_all_defaults():
    table = ROW.findall((ROOT / "docs" / "guides" / "sensor_parameters.md").read_text())
    expected = {field.name: field.default for field in fields(Sensor) if field.name != "layout"}

    assert len(table) == len(expected)
    assert {name: ast.literal_eval(default) for name, default in table} == expected
