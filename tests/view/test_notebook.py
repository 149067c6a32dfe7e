"""HTML of objects in notebooks: content, escaping, size, colours."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import foveasim as fs
from foveasim import metrics, sensor
from foveasim.errors import ParameterError
from foveasim.view import to_html, to_png
from foveasim.view.notebook._blocks import facts, panel, table
from foveasim.view.notebook._thumbnails import THUMBNAIL_PIXELS, encode_png
from foveasim.view.site_colours import BACKGROUND

MAX_THUMBNAIL_BYTES, MAX_HTML_BYTES = 60_000, 120_000
SITES = fs.layout.log_polar(24, r_max_um=54.7, min_size_um=2.0)
SENSOR = fs.Sensor(
    SITES, read_noise_e=1.5, prnu_fraction=0.01, dark_e_per_s=np.linspace(1.0, 2.0, SITES.n_sites), capacitance_f=5e-15
)
CAMERA = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8, transmission=0.9), sensor=SENSOR)
RNG = np.random.default_rng(0)
SCENE = fs.Scene.from_picture(
    RNG.integers(0, 255, (300, 400, 3)).astype(np.uint8), pitch_um=50.0, distance_m=0.5, peak_radiance_w_m2_sr_nm=0.02
)
EVIL = "<script>alert('&')</script>\n"


@pytest.fixture(scope="module")
def capture():
    return CAMERA.capture(SCENE, exposure_s=0.01, seed=3)


@pytest.fixture(scope="module")
def items(capture):
    """Return one object of each kind with a representation in HTML."""
    rules = fs.DesignRules(min_size_um=2.5, max_aspect_ratio=1.02, waivers={"max_aspect_ratio": EVIL})
    return {
        "layout": SITES.with_columns(**{EVIL: np.arange(SITES.n_sites)}).with_provenance({"generator": EVIL}),
        "capture": capture,
        "sensor": SENSOR,
        "camera": CAMERA,
        "optics": CAMERA.optics,
        "scene": replace(SCENE, source=EVIL),
        "picture": capture.picture(),
        "power map": CAMERA.power_map(SCENE),
        "report": SITES.check(rules),
        "summary": replace(SITES.describe(), origin=EVIL),
        "snr": metrics.snr_by_class(CAMERA, SCENE, exposure_s=0.01),
        "budget": CAMERA.noise_budget(SCENE, exposure_s=0.01),
        "eccentricity": metrics.nyquist_vs_eccentricity(SITES),
        "photon transfer": metrics.PhotonTransfer(
            np.array([EVIL]), np.ones(1, int), np.ones(3, int), *np.ones((3, 3, 1))
        ),
    }


class Page(HTMLParser):
    """Tags, attributes and text of HTML; raises when tags are not closed in order."""

    def __init__(self, html):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def pictures_of(html):
    return [base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]*)"', html)]


def pixels_of(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


@pytest.mark.slow
def test_html_is_self_contained_and_escaped(items):
    for item in items.values():
        page = Page(item._repr_html_())

        assert set(page.tags) <= {"div", "table", "thead", "tbody", "tr", "th", "td", "img", "span"}
        assert {name for name, _ in page.attributes} <= {"style", "width", "height", "alt", "src"}
        assert not any("url(" in value or value.startswith("http") for _, value in page.attributes)
    for name in ("layout", "scene", "report", "summary", "photon transfer"):
        assert "<script>alert('&')</script>\\n" in "".join(Page(items[name]._repr_html_()).text), name


def test_html_has_no_colours_of_text(items):
    for item in items.values():
        styles = ";".join(value for name, value in Page(item._repr_html_()).attributes if name == "style")

        assert not re.search(r"(?<![-\w])color\s*:", styles)
        backgrounds = set(re.findall(r"background:([^;]*)", styles))
        assert all(b in {"none", "currentColor"} or b.startswith("#") for b in backgrounds)


@pytest.mark.slow
def test_html_and_thumbnails_are_small(items):
    for name, item in items.items():
        html = item._repr_html_()

        assert len(html) < MAX_HTML_BYTES, name
        for png in pictures_of(html):
            assert len(png) < MAX_THUMBNAIL_BYTES, name
            assert max(Image.open(io.BytesIO(png)).size) <= THUMBNAIL_PIXELS
    shown = {name for name, item in items.items() if pictures_of(item._repr_html_())}
    assert shown == {"layout", "capture", "camera", "scene", "picture", "power map", "report"}


def test_html_contains_key_figures(items, capture):
    text = {name: " ".join(Page(item._repr_html_()).text) for name, item in items.items()}

    assert f"{SITES.n_sites:,} photosites" in text["layout"]
    assert f"to {capture.code.max():,} of 255 DN" in text["capture"]
    assert "10 ms" in text["capture"]
    assert "read_noise_e = 1.5 e-" in text["sensor"]
    assert "1 to 2 e-/s" in text["sensor"]
    for effect in SENSOR.chain:
        assert effect.name in text["sensor"]
        assert effect.name in text["camera"]
    assert "8 mm, f/2.8" in text["camera"]
    assert "transmission 0.9" in text["optics"]
    assert "20 x 15 mm at 0.5 m" in text["scene"]
    assert "620, 550, 450 nm" in text["scene"]
    assert "W/m² per band" in text["power map"]
    assert "photon_shot" in text["budget"]
    for result in items["report"].results:
        assert result.rule in text["report"]


def test_layout_thumbnail_is_transparent_outside_sites():
    (png,) = pictures_of(SITES._repr_html_())
    alpha = pixels_of(png)[..., 3]
    y, x = np.mgrid[-1.0 : 1.0 : alpha.shape[0] * 1j, -1.0 : 1.0 : alpha.shape[1] * 1j]
    r = np.hypot(x, y)
    r_min = np.linalg.norm(SITES.xy_um, axis=1).min() / 54.7

    assert np.all(alpha[(r > 1.05) | (r < r_min - 0.1)] == 0)
    assert np.all(alpha[(r < 0.95) & (r > r_min + 0.1)] == 255)


def test_capture_thumbnail_has_background(capture):
    (png,) = pictures_of(capture._repr_html_())
    pixels = pixels_of(png)

    assert np.all(pixels[..., 3] == 255)
    assert tuple(pixels[0, 0, :3]) == BACKGROUND


def test_picture_is_upright_and_transparent_without_data():
    data = np.full((1, 20, 30), 1.0, np.float32)
    data[0, :10] = np.nan  # rows of low y
    data[0, 10:, :15] = 0.5
    picture = fs.Picture(data, (~np.isnan(data[0])).astype(np.float32), fs.Grid((20, 30), 1.0))
    for png in (to_png(picture), picture._repr_png_(), *pictures_of(picture._repr_html_())):
        pixels = pixels_of(png)

        assert pixels.shape == (20, 30, 4)
        assert np.all(pixels[10:, :, 3] == 0)
        assert np.all(pixels[:10, :, 3] == 255)
        assert np.all(pixels[:10, 15:, 0] == 255)
        assert set(np.unique(pixels[:10, :15, 0])) <= {188}  # 0.5 in sRGB


@pytest.mark.parametrize("n_channels", [1, 2, 3, 5])
def test_pictures_of_any_channels_are_shown(n_channels):
    data = RNG.random((n_channels, 900, 600)).astype(np.float32)
    picture = fs.Picture(data, np.ones((900, 600), np.float32), fs.Grid((900, 600), 1.0))
    pixels = pixels_of(to_png(picture))

    assert max(pixels.shape[:2]) <= 640
    assert pixels.shape[0] == pytest.approx(1.5 * pixels.shape[1], abs=2)


def test_noisy_pictures_are_reduced_to_size():
    noise = RNG.integers(0, 255, (280, 280, 4)).astype(np.uint8)
    png, size = encode_png(noise, 20_000)

    assert len(png) <= 20_000
    assert Image.open(io.BytesIO(png)).size == size
    assert size[0] == size[1] < 280
    flat, size = encode_png(np.full((280, 280, 3), 7, np.uint8))
    assert size == (280, 280)
    assert np.all(pixels_of(flat)[..., :3] == 7)


def test_report_thumbnail_circles_violations():
    sites = fs.Layout.from_rectangles([[0, 0], [40, 0], [0, 40], [40, 40]], [[10, 10], [10, 10], [2, 2], [10, 10]])
    report = sites.check(fs.DesignRules(min_size_um=5.0))
    (png,) = pictures_of(report._repr_html_())
    pixels = pixels_of(png).astype(int)
    is_red = (pixels[..., 0] > 180) & (pixels[..., 1] < 90) & (pixels[..., 3] > 200)
    y, x = np.nonzero(is_red)
    n_y, n_x = is_red.shape

    # The small site is at (5, 45) µm of 50 µm from the lower left corner: left, at the top.
    assert x.mean() / n_x == pytest.approx(0.1, abs=0.02)
    assert y.mean() / n_y == pytest.approx(0.1, abs=0.02)


def test_report_of_a_file_has_table_only(tmp_path):
    report = SITES.check(fs.DesignRules(min_size_um=2.5))
    bare = replace(report, layout=None)

    assert pictures_of(report._repr_html_())
    assert not pictures_of(bare._repr_html_())
    assert "min_size_um" in bare._repr_html_()


def test_empty_layout_has_html():
    empty = SITES[np.zeros(SITES.n_sites, bool)]

    assert "Layout of 0 photosites" in empty._repr_html_()
    assert "0 photosites" in fs.Sensor(empty)._repr_html_()


def test_million_sites_have_small_html():
    sites = fs.layout.grid(1000, 1000, 1.0)
    html = sites._repr_html_()

    assert "1,000,000 photosites" in html
    assert len(html) < MAX_HTML_BYTES


def test_narrow_layout_has_thumbnail():
    (png,) = pictures_of(fs.layout.grid(5000, 1, 1.0)._repr_html_())

    assert Image.open(io.BytesIO(png)).size == (THUMBNAIL_PIXELS, 8)


def test_user_effects_are_listed():
    class Ripple(sensor.effects.AdditiveNoise):
        name, stage = "ripple", "output"

        def deviation(self, sites):
            return 0.001

    html = fs.Sensor(SITES, effects=[Ripple()])._repr_html_()

    assert "ripple" in html


def test_tables_align_numbers_and_count_rows():
    html = table(("name", "value"), [(f"n{k}", 0.5 * k) for k in range(100)])

    assert html.count("<tr") == 61
    assert "and 40 more rows" in html
    assert html.count("text-align:right") == 61
    assert facts({"a": "", "b": None, "c": 0}).count("<tr") == 1
    assert facts({}) == ""
    assert "<b>" not in panel("<b>", facts({"<b>": "<b>"}))


def test_objects_without_figures_are_rejected():
    with pytest.raises(ParameterError, match="'item' must be an object of foveasim with figures to show, got 3"):
        to_html(3)
