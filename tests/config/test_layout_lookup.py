"""Layouts by path or by name: one lookup for the library, the command line and settings files."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from cli.conftest import run_here

import foveasim as fs
from foveasim.config import read_any_layout, read_shot
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.layout import bundled_layouts

SHOT = """
scene: {kind: flat, shape: [40, 40], pitch_um: 100, distance_m: 1.0, radiance_w_m2_sr_nm: 0.1, band_width_nm: 10}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: prima_100
exposure_s: 0.01
"""


@pytest.fixture
def command(monkeypatch, capsys):
    """Return a function that runs the program in this process."""
    return partial(run_here, monkeypatch, capsys.readouterr)


@pytest.fixture
def two_sites():
    return fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)


def write_as(layout, path):
    """A layout in a file whose name has no extension."""
    layout.write(path.with_suffix(".npz"))
    path.with_suffix(".npz").rename(path)


@pytest.mark.parametrize("name", ["giotto_2", "prima_75"])
def test_read_layout_finds_bundled_layouts_by_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    layout = fs.read_layout(name)

    assert isinstance(layout, fs.Layout)
    assert np.array_equal(layout.xy_um, read_any_layout(bundled_layouts()[name]).layout.xy_um)


def test_read_layout_reads_files_of_any_format(tmp_path, two_sites):
    two_sites.write(tmp_path / "two.geojson")
    (tmp_path / "two.yaml").write_text("generator: grid\nparameters: {n_x: 2, n_y: 1, pitch_um: 2.0}\n")

    for name in ("two.geojson", "two.yaml"):
        assert np.array_equal(fs.read_layout(tmp_path / name).xy_um, two_sites.xy_um)
    with pytest.raises(ParameterError, match="'layer' is an option of DXF, GDSII and OASIS files only, got 3; omit it"):
        fs.read_layout(tmp_path / "two.yaml", layer=3)
    with pytest.raises(ParameterError, match="'cell' is an option of GDSII, NeXus and OASIS files"):
        fs.read_layout("giotto_2", cell="TOP")


def test_files_precede_bundled_names(command, tmp_path, monkeypatch, two_sites):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "giotto_1").mkdir()
    write_as(two_sites, tmp_path / "prima_100")

    assert fs.read_layout("prima_100").n_sites == 2
    assert " 2 " in command("describe", "prima_100", cwd=tmp_path).stdout
    # A folder is not a layout.
    assert fs.read_layout("giotto_1").n_sites == 8309


def test_settings_files_search_own_directory_first(tmp_path, monkeypatch, two_sites):
    (tmp_path / "settings").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "settings" / "shot.yaml").write_text(SHOT)
    write_as(two_sites, tmp_path / "elsewhere" / "prima_100")
    monkeypatch.chdir(tmp_path / "elsewhere")

    assert read_shot(tmp_path / "settings" / "shot.yaml").camera.sensor.layout.n_sites == 378
    write_as(two_sites, tmp_path / "settings" / "prima_100")
    assert read_shot(tmp_path / "settings" / "shot.yaml").camera.sensor.layout.n_sites == 2


def test_read_layout_suggests_bundled_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        FileError, match=r"giotto_2: no such file; foveasim.read_layout reads the bundled layout of this"
    ):
        fs.layout.read_layout("giotto_2")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "giotto_3",
            "giotto_3: no such file, and not the name of a bundled layout; did you mean 'giotto_2'? possible: ",
        ),
        ("zzzz", "zzzz: no such file, and not the name of a bundled layout; possible: 'bayer_grid', 'four_zones', "),
        ("giotto_2.yaml", "giotto_2.yaml: no such file; 'giotto_2' is a bundled layout"),
        ("sub/giotto_2", "sub/giotto_2: no such file"),
        ("nowhere.gds", "nowhere.gds: no such file"),
    ],
)
def test_unknown_names_are_rejected_with_the_closest(command, name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileError) as caught:
        fs.read_layout(name)
    found = command("check", name, cwd=tmp_path)

    assert str(caught.value).startswith(words)
    assert (found.returncode, found.stderr.strip()) == (2, f"error: {caught.value}")


# -- chip files -------------------------------------------------------------------------------------------------------

CHIP_SHOT = """
scene: {{kind: flat, shape: [40, 40], pitch_um: 100, distance_m: 1.0, radiance_w_m2_sr_nm: 0.1, band_width_nm: 10}}
optics: {{focal_length_mm: 8, f_number: 2.8}}
layout: {layout}
sensor: {{filters: rgb}}
exposure_s: 0.01
"""


@pytest.fixture
def chip(tmp_path):
    """A directory with a chip file without properties, as from another program; returns the layout."""
    gdstk = pytest.importorskip("gdstk")
    layout = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=4, pitch_um=2.0), ("RG", "GB"))
    layers = {"photosite": (77, 3), "filter_R": (10, 0), "filter_G": (11, 0), "filter_B": (12, 0)}
    layout.write(tmp_path / "chip.gds", layers=layers, hierarchy=False)
    library = gdstk.read_gds(tmp_path / "chip.gds")
    for polygon in library.cells[0].polygons:
        polygon.properties = []
    library.write_gds(tmp_path / "chip.gds")
    (tmp_path / "map.yaml").write_text("photosite: 77/3\nfilter_R: 10\nfilter_G: 11\nfilter_B: 12/0\n")
    return layout


@pytest.mark.parametrize(
    "section",
    [
        "{file: chip.gds, layer: 77/3, channels: {10/0: R, 11: 1, 12/0: B}}",
        "{file: chip.gds, cell: SENSOR, layers: {photosite: 77/3, filter_R: 10, filter_G: 11/0, filter_2: {layer: 12}}}",
        "{file: chip.gds, layers: map.yaml, inset_um: 0.1}",
        "{file: chip.gds, layer: 77, channels: {10: C, 11: M, 12: Y}, filter_names: [C, M, Y]}",
    ],
)
def test_settings_read_channels_of_chip(chip, tmp_path, section):
    (tmp_path / "shot.yaml").write_text(CHIP_SHOT.format(layout=section))
    read = read_shot(tmp_path / "shot.yaml").camera.sensor.layout
    place = np.lexsort(read.centroid_um.round(3).T)

    np.testing.assert_array_equal(read.channel[place], chip.channel)


def test_layout_file_names_chip_with_rules(chip, tmp_path):
    (tmp_path / "layout.yaml").write_text(
        "file: chip.gds\nlayers: map.yaml\nrules: {min_size_um: 1.0}\nsource: a foundry\n"
    )
    found = read_any_layout(tmp_path / "layout.yaml")

    assert found.layout.n_sites == chip.n_sites
    assert (found.rules.min_size_um, found.source) == (1.0, "a foundry")


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            "{file: chip.gds, layer: 77/3}",
            "sensor: the sensor has 3 filters, but the layout has no column 'channel'; add it",
        ),
        ("{file: chip.gds}", "layout: .*several layers, 10/0, 11/0, 12/0, 77/3; select one with layer="),
        ("{file: chip.gds, layer: 78}", "layout: .*has no shape on layer 78"),
        (
            "{file: chip.gds, layer: 77, channels: {10: X}}",
            "layout.channels: must have channels as numbers, or as names",
        ),
        ("{file: chip.gds, layers: {photosit: 77/3}}", "layout.layers: .*did you mean 'photosite'"),
        ("{file: chip.gds, layers: other.yaml}", "layout: .*other.yaml: no such file"),
        ("{file: chip.gds, layr: 77}", "layout.layr: unknown key; did you mean 'layer'"),
        ("{file: chip.gds, generator: grid}", "layout.generator: unknown key"),
        ("{file: shot.yaml}", "layout.file: must not be a YAML file, got 'shot.yaml'"),
        ("{file: none.gds}", "layout: .*none.gds: no such file"),
    ],
)
@pytest.mark.usefixtures("chip")
def test_invalid_chip_settings_give_one_line(tmp_path, section, message):
    (tmp_path / "shot.yaml").write_text(CHIP_SHOT.format(layout=section))
    with pytest.raises(ConfigError, match=message) as caught:
        read_shot(tmp_path / "shot.yaml")
    assert "\n" not in str(caught.value)
