"""Start page: templates of new sensors, descriptions and thumbnails of presets, recent files."""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scripts import load_script

import foveasim as fs
from foveasim.config import bundled_layouts, demo_settings
from foveasim.layout import OPTICAL_FORMATS
from foveasim.layout.sizes.sizing import sizable
from foveasim.studio._files import Files, apply_preset
from foveasim.studio._start import contents_of
from foveasim.studio._start.new_sensor import electronics, mosaics

THUMBNAILS = Path(fs.__file__).parent / "studio" / "static" / "presets"
MAX_BYTES = 400_000
#: Generators whose outlines end at the sides of a rectangle; the others are circles or squares.
FILLING = {"grid", "hexagonal", "octagonal", "tiling", "voronoi"}
#: Generators with few possible numbers: integer rings, rows, columns or pixels across the fovea.
COARSE = {"foveal_cartesian", "octagonal", "zones"}


def create(recorder, **changes):
    template = {
        "generator": "grid", "size_um": [4800.0, 3600.0], "n_sites": 2000, "filters": "RGGB", "electronics": "machine_vision",
    }  # fmt: skip
    return recorder.do(do="new_sensor", id=1, **{**template, **changes})


def contents(recorder):
    return contents_of(recorder.session.files)


@pytest.fixture(scope="module")
def script():
    return load_script("docs/preset_thumbnails.py")


# -- new sensors --------------------------------------------------------------------------------------------------------


def test_all_bundled_generators_have_templates():
    of_points = {"voronoi_of"}  # whose points only the user knows
    assert set(sizable()) == set(fs.layout.LAYOUTS.within("foveasim.layout.generators")) - of_points


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("n_sites", [1000, 4000])
@pytest.mark.parametrize("generator", sizable())
def test_template_fills_its_format(recorder, generator, n_sites):
    width_um, height_um = OPTICAL_FORMATS["1/2.3"].size_um
    state = create(recorder, generator=generator, n_sites=n_sites, size_um=[width_um, height_um])
    result = recorder.session.result
    layout = result.capture.layout
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um

    assert state["errors"] == {}
    assert layout.n_sites == pytest.approx(n_sites, rel=0.08 if generator in COARSE else 0.03)
    assert layout.check(result.shot.rules).ok
    assert result.shot.rules.limits()
    assert not [text for text in state["warnings"] if "outside" in text]
    assert state["summary"]["saturated_fraction"] < 0.02
    # The field ends within a pitch of the format, and does not exceed it.
    pitch_um = np.sqrt(width_um * height_um / n_sites)
    expected_um = (width_um, height_um) if generator in FILLING else (min(width_um, height_um),) * 2
    assert np.all(np.array([x1_um - x0_um, y1_um - y0_um]) <= np.array(expected_um) * (1.0 + 1e-9))
    assert np.all(np.array([x1_um - x0_um, y1_um - y0_um]) >= np.array(expected_um) - 2.0 * pitch_um)
    assert max(-x0_um, x1_um) <= 0.5 * expected_um[0] * (1.0 + 1e-9)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("fovea", ["rings", "linear", "hexagons"])
@pytest.mark.parametrize("generator", ["log_polar", "giotto"])
def test_filled_fovea_stays_in_the_format(recorder, generator, fovea):
    create(recorder, generator=generator, n_sites=3000, filters=None)
    state = recorder.do(do="set", key="layout.parameters.fovea", value=fovea)

    assert state["errors"] == {}
    for side_um in (state["summary"]["width_um"], state["summary"]["height_um"]):
        assert 0.9 * 3600.0 <= side_um <= 3600.0 * (1.0 + 1e-9)


@pytest.mark.slow
def test_new_sensor_is_one_step(recorder, settings):
    create(recorder, generator="sunflower")
    state = recorder.do(do="undo", id=2)

    assert state["settings"] == settings
    assert not state["can_undo"]


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("filters", [None, *mosaics()])
@pytest.mark.parametrize("generator", ["hexagonal", "voronoi"])
def test_filters_are_those_of_the_template(recorder, generator, filters):
    state = create(recorder, generator=generator, filters=filters, n_sites=500)
    layout = recorder.session.result.capture.layout

    assert state["errors"] == {}
    assert state["settings"]["sensor"].get("filters") == (None if filters is None else "rgb")
    assert np.unique(layout.channel).size == (1 if filters is None else 3)
    if filters == "RGGB" and generator == "hexagonal":
        assert np.bincount(layout.channel) / layout.n_sites == pytest.approx([0.25, 0.5, 0.25], abs=0.03)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", electronics())
def test_electronics_are_those_of_the_preset(recorder, name):
    sensor = create(recorder, electronics=name)["settings"]["sensor"]

    for key, value in fs.sensor.PRESETS[name].settings().items():
        assert sensor[key] == value
    assert fs.sensor.PRESETS["mobile"].settings() != fs.sensor.PRESETS["scientific"].settings()


@pytest.mark.slow
def test_chart_covers_a_large_sensor(recorder):
    """The checkerboard of these tests is far smaller than one inch."""
    state = create(recorder, size_um=list(OPTICAL_FORMATS["1"].size_um))

    assert state["settings"]["scene"]["kind"] == "checkerboard"
    assert [text for text in state["warnings"] if "outside" in text] == []


def test_new_sensor_is_centred(make_session):
    recorder = make_session(start=apply_preset("shot:foveal", {}))
    state = create(recorder)

    assert state["errors"] == {}
    assert state["settings"].get("gaze_um") is None
    assert state["settings"]["scene"]["fit"] == "cover"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"generator": "spiral"}, "'generator' must be one of"),
        ({"generator": ["grid"]}, "'generator' must be a string"),
        ({"size_um": [0.0, 3600.0]}, "(size_um)"),
        ({"size_um": "wide"}, "(size_um) must be the width and the height"),
        ({"n_sites": 0}, "Photosites (n_sites) must be an integer from 1 to 2,000,000, got 0"),
        ({"n_sites": 10**9}, "Photosites (n_sites) must be an integer from 1 to 2,000,000"),
        ({"n_sites": "many"}, "Photosites (n_sites) must be"),
        ({"min_size_um": 0}, "must be a positive number, got 0"),
        ({"filters": "cmyk"}, "(filters) must be one of"),
        ({"electronics": "paper_read_noise"}, "'electronics' must be one of"),
        ({"generator": "zones", "n_sites": 2}, "the nearest is"),
    ],
)
def test_invalid_templates_are_rejected(recorder, settings, changes, message):
    state = create(recorder, **changes)

    assert message in state["errors"]["new_sensor"]
    assert state["settings"] == settings


# -- requirements of new sensors ------------------------------------------------------------------------------------------

FORMAT_UM = [4800.0, 3600.0]


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("generator", ["grid", "log_polar", "hexagonal", "giotto", "sunflower"])
@pytest.mark.parametrize("has_format", [True, False])
def test_smallest_site_is_as_required(recorder, generator, has_format):
    wanted = {"size_um": FORMAT_UM, "n_sites": None} if has_format else {"size_um": None, "n_sites": 2000}
    state = create(recorder, generator=generator, min_size_um=40.0, **wanted)
    layout = recorder.session.result.capture.layout
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um

    assert state["errors"] == {}
    assert np.sqrt(layout.area_um2.min()) == pytest.approx(40.0, rel=0.05)
    if has_format:
        assert x1_um - x0_um <= FORMAT_UM[0] * (1.0 + 1e-9)
        assert 3000.0 < y1_um - y0_um <= FORMAT_UM[1] * (1.0 + 1e-9)
    else:
        assert layout.n_sites == pytest.approx(2000, rel=0.08)


def test_resolution_at_gaze_follows_from_lens(recorder):
    """The image of the test scene, at 1 m, is 8.0645 mm behind the lens of 8 mm: 1 / (1/8 - 1/1000)."""
    create(recorder, generator="grid", size_um=FORMAT_UM, n_sites=None, sites_per_deg=4.0)
    pitch_um = np.sqrt(recorder.session.result.capture.layout.area_um2.min())

    assert pitch_um == pytest.approx(8064.5 * np.tan(np.pi / 180) / 4.0, rel=0.05)


def test_data_rate_limits_number_of_sites(recorder):
    create(recorder, generator="grid", size_um=FORMAT_UM, n_sites=None, pixels_per_s=60_000.0, frames_per_s=20.0)

    assert recorder.session.result.capture.layout.n_sites == pytest.approx(3000, rel=0.03)


def test_new_log_polar_sensor_has_filled_fovea(recorder):
    create(recorder, generator="log_polar", n_sites=1500)
    layout = recorder.session.result.capture.layout

    assert np.hypot(*layout.centroid_um.T).min() < layout.size_um.min()


def test_layout_with_blind_spot_is_centred(make_session):
    recorder = make_session(start=apply_preset("shot:foveal", {}))
    state = recorder.do(do="preset", name="layout:foveal_blind_spot", id=1)

    assert state["errors"] == {}
    assert state["settings"].get("gaze_um") is None


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"n_sites": None, "size_um": None}, ["give a format, or the smallest site"]),
        # A grid of 4.8 × 3.6 mm has 120 × 90 sites of 40 µm.
        (
            {"min_size_um": 40.0, "n_sites": 3000},
            ["cannot have 3,000 photosites of 40 µm", "possible are 10,800 of 40 µm, or 2,961 of 76.2 µm"],
        ),
        ({"min_size_um": 40.0, "n_sites": 50_000}, ["possible are 10,800 of 40 µm, or 50,000 of 18.6 µm"]),
        (
            {"generator": "log_polar", "min_size_um": 100.0, "n_sites": 5000},
            ["in 4.8 × 3.6 mm", "possible are 1,018 of 100 µm"],
        ),
        (
            {"min_size_um": 0.4, "n_sites": None},
            ["108,000,000 photosites of 0.4 µm", "possible are 2,000,000 of 2.94 µm"],
        ),
        (
            {"min_size_um": 40.0, "sites_per_deg": 10.0},
            ["require sites of 14.1 µm", "possible are 3.519 sites per degree"],
        ),
        ({"n_sites": 2000, "pixels_per_s": 30_000.0}, ["possible are 1,000 at 30 frames/s, or 15 frames/s"]),
    ],
)
def test_contradicting_requirements_are_explained(recorder, settings, changes, parts):
    state = create(recorder, **changes)
    text = state["errors"]["new_sensor"]

    for part in parts:
        assert part in text
    assert ". " not in text
    assert state["settings"] == settings


# -- presets --------------------------------------------------------------------------------------------------------------


def test_presets_have_one_description(recorder):
    """The sentence is the first line of the file of the preset."""
    paths = {"shot": {path.stem: path for path in demo_settings()}, "layout": bundled_layouts()}
    found = contents(recorder)["presets"]

    assert len(found) == len(paths["shot"]) + len(paths["layout"])
    for each in found:
        kind, _, stem = each["name"].partition(":")
        assert f"# {each['text']}" == paths[kind][stem].read_text(encoding="utf-8").splitlines()[0]
        assert re.fullmatch(r"[A-Z].{30,160}\.", each["text"])


def test_thumbnails_are_complete_and_small(recorder):
    names = {each["picture"] for each in contents(recorder)["presets"]}

    assert {path.name for path in THUMBNAILS.iterdir()} == names
    assert sum(path.stat().st_size for path in THUMBNAILS.iterdir()) <= MAX_BYTES


def on_white(image):
    """Return the pixels of a picture with transparent parts, on a page."""
    return np.asarray(Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA")), float)


@pytest.mark.slow(keep="four_zones")
@pytest.mark.filterwarnings("ignore:.* % of the photosites")
@pytest.mark.parametrize("name", [f"layout:{name}" for name in bundled_layouts()] + ["shot:foveal", "shot:four_zones"])
def test_thumbnails_are_up_to_date(script, name):
    stored, made = Image.open(THUMBNAILS / f"{name.replace(':', '_')}.webp"), script.thumbnail(name)

    assert stored.size == made.size
    # Other versions of libraries round differently; another layout differs by more than 1.
    assert np.abs(on_white(stored) - on_white(made)).mean() < 0.2


def test_thumbnails_of_other_layouts_differ():
    pictures = [on_white(Image.open(path)) for path in sorted(THUMBNAILS.iterdir())]
    differences = [np.abs(one - other).mean() for one, other in itertools.combinations(pictures, 2)]

    assert min(differences) > 1.0


# -- recent files -----------------------------------------------------------------------------------------------------------


def write(path, settings, age_s=0.0):
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    time_s = path.stat().st_mtime - age_s
    os.utime(path, (time_s, time_s))
    return path


def test_newest_shots_are_listed_first(make_session, settings, tmp_path):
    out, directory = tmp_path / "out", tmp_path / "shots"
    out.mkdir()
    directory.mkdir()
    write(out / "old.yaml", settings, 300.0)
    write(directory / "new.yml", settings, 100.0)
    write(out / "middle.yaml", settings, 200.0)
    write(out / ".hidden.yaml", settings)
    write(out / "sweep.yaml", {"shot": settings})
    (out / "broken.yaml").write_text("scene: [")
    write(tmp_path / "elsewhere.yaml", settings)
    (out / "link.yaml").symlink_to(tmp_path / "elsewhere.yaml")
    found = contents(make_session(out=out, directory=directory))["recent"]

    assert [each["name"] for each in found] == ["new.yml", "middle.yaml", "old.yaml"]
    assert [each["directory"] for each in found] == ["shots", "out", "out"]
    assert np.all(np.diff([each["time_s"] for each in found]) < 0.0)


def test_sessions_without_directories_have_no_files(recorder):
    assert contents(recorder)["recent"] is None


def test_deleted_directory_has_no_files(make_session, tmp_path):
    recorder = make_session(out=tmp_path / "gone")

    assert contents(recorder)["recent"] == []


def test_saved_settings_are_opened_again(make_session, settings, tmp_path):
    """The picture of the scene is in the directory of saved files, with a relative path."""
    recorder = make_session(out=tmp_path)
    Image.new("RGB", (64, 64), "grey").save(tmp_path / "grey.png")
    scene = {"kind": "picture", "picture": "grey.png", "pitch_um": 500.0, "distance_m": 1.0,
             "peak_radiance_w_m2_sr_nm": 0.02, "wavelength_nm": [620, 550, 450]}  # fmt: skip
    write(tmp_path / "saved.yaml", {**settings, "scene": scene})
    (path,) = (each["path"] for each in contents(recorder)["recent"])
    state = recorder.do(do="file", path=path, **{"as": "settings"})

    assert state["errors"] == {}
    assert state["settings"]["scene"]["picture"] == str(tmp_path / "grey.png")
    assert recorder.do(do="undo", id=2)["settings"] == settings


@pytest.mark.parametrize("path", ["/etc/hostname.yaml", "../secret.yaml", ".hidden.yaml", "link.yaml"])
def test_other_files_are_not_opened(make_session, settings, tmp_path, path):
    out = tmp_path / "out"
    out.mkdir()
    write(tmp_path / "secret.yaml", settings)
    write(out / ".hidden.yaml", settings)
    (out / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    recorder = make_session(out=out)
    state = recorder.do(do="file", path=str(out / path), **{"as": "settings"})

    assert "is not available here" in state["errors"]["file"]
    assert not Files(settings, (None, out), tmp_path / "uploads", out / "variants").allows(out / path)
