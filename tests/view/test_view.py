"""Plots on matplotlib axes: positions and colours of photosites, overlays, reports and files."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import shapely
from matplotlib.figure import Figure

import foveasim as fs
from foveasim._io.images import read_picture
from foveasim.errors import FileError, ParameterError
from foveasim.view import (
    colours_of,
    plot_layout,
    plot_noise_budget,
    plot_report,
    save_drawing,
    save_figure,
    site_colours,
)
from foveasim.view._artists import SiteImage, format_length, nice_length_um
from foveasim.view.plots.sites import MAX_OUTLINES
from foveasim.view.site_colours import BACKGROUND, CATEGORY_COLOURS, FILTER_COLOURS, NO_DATA

FRAME = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(2, 2), (2, 6), (6, 6), (6, 2)]])
LAYOUT = fs.Layout.from_polygons([FRAME, shapely.box(10, 0, 12, 8)])
#: More sites than the limit for outlines.
MANY = fs.layout.grid(n_x=64, n_y=64, pitch_um=2.0)
CHEQUERED = np.add.outer(np.arange(64), np.arange(64)).ravel() % 2


def render_pixels(axes, tmp_path, dpi=100):
    """Render the interior of the axes, stretched over the figure, top row first."""
    axes.set_position((0, 0, 1, 1))
    axes.axis("off")
    axes.figure.set_layout_engine("none")
    save_figure(axes.figure, tmp_path / "plot.png", dpi=dpi)
    return read_picture(tmp_path / "plot.png")[..., :3]


def bare_axes(width=6, height=4):
    return Figure(figsize=(width, height), facecolor="white").add_axes((0, 0, 1, 1))


@pytest.fixture(scope="module")
def mosaic_capture():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0), ("RG", "GB"))
    sensor = fs.Sensor(layout, filters="rgb", capacitance_f=1e-15)
    scene = fs.Scene.flat(
        shape=(100, 100), pitch_um=20.0, distance_m=0.5, radiance_w_m2_sr_nm=1.0, wavelength_nm=(450, 540, 610)
    )
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor)
    return camera.capture(scene, exposure_s=0.01, seed=0)


# -- outlines and images -------------------------------------------------------------------------------------------


def test_outlines_leave_holes_and_gaps_open(tmp_path):
    axes = plot_layout(LAYOUT, np.array([[1.0, 0, 0], [0, 0, 1.0]]), scale_bar=False, ax=bare_axes())
    picture = render_pixels(axes, tmp_path)
    red, blue = (np.all(picture == colour, axis=-1).mean() for colour in ([255, 0, 0], [0, 0, 255]))

    # Of the plot's 12 x 8 µm the frame covers 64 - 16 µm² and the box 16 µm².
    assert red == pytest.approx(48 / 96, abs=0.02)
    assert blue == pytest.approx(16 / 96, abs=0.02)
    assert not np.all(picture[200, 200] == [255, 0, 0])


@pytest.mark.parametrize("n", [1, 60], ids=["outlines", "image"])
def test_y_up_and_x_right(tmp_path, n):
    layout = fs.layout.grid(n_x=2 * n, n_y=2 * n, pitch_um=2.0)
    is_high, is_right = (layout.centroid_um[:, i] > 0 for i in (1, 0))
    assert (layout.n_sites > MAX_OUTLINES) == (n > 1)
    axes = layout.plot(np.stack((is_high, is_right, is_high), axis=1) * 1.0, scale_bar=False, ax=bare_axes(4, 4))
    picture = render_pixels(axes, tmp_path)

    assert np.all(picture[50:150, 50:150] == [255, 0, 255])
    assert np.all(picture[250:350, 250:350] == [0, 255, 0])
    assert np.all(picture[50:150, 250:350] == 255)


def test_image_shows_sites_and_uncovered_areas(tmp_path):
    complete = fs.layout.grid(n_x=64, n_y=96, pitch_um=2.0)
    layout = complete[(complete.centroid_um[:, 0] > 0) | (complete.centroid_um[:, 0] < -32.0)]
    assert layout.n_sites > MAX_OUTLINES
    axes = plot_layout(layout, np.zeros((layout.n_sites, 3)), scale_bar=False, ax=bare_axes(4, 6))
    assert tuple(round(255 * c) for c in axes.get_facecolor()[:3]) == BACKGROUND
    picture = render_pixels(axes, tmp_path)

    assert np.all(picture[:, :99] == 0)
    assert np.all(picture[:, 101:199] == 255)
    assert np.all(picture[:, 201:] == 0)


def test_image_matches_outlines(tmp_path, monkeypatch):
    layout = fs.layout.log_polar(n_sectors=60, min_size_um=1.0, r_max_um=20.0)
    colours = np.random.default_rng(0).integers(0, 256, (layout.n_sites, 3), dtype=np.uint8)
    pictures = []
    for max_outlines in (0, 10**6):
        monkeypatch.setattr("foveasim.view.plots.sites.MAX_OUTLINES", max_outlines)
        axes = plot_layout(layout, colours, scale_bar=False, ax=bare_axes(4, 4))
        assert bool(axes.images) == (max_outlines == 0)
        pictures.append(render_pixels(axes, tmp_path).astype(float))

    difference = np.abs(pictures[0] - pictures[1])
    assert np.median(difference) == 0.0
    assert difference.mean() < 3.0  # of 255: outlines have a rim of 0.3 points


def test_image_sharp_at_any_zoom(tmp_path):
    axes = plot_layout(MANY, CHEQUERED[:, None] * np.ones(3), scale_bar=False, ax=bare_axes(4, 4))
    axes.set_xlim(-2.0, 2.0)
    axes.set_ylim(-2.0, 2.0)
    for dpi in (50, 200):
        picture = render_pixels(axes, tmp_path, dpi=dpi)
        values, counts = np.unique(picture, return_counts=True)

        # Four squares of one colour each, except for the pixels on their boundaries.
        assert counts[np.isin(values, (0, 255))].sum() / picture.size > 1 - 4.5 / (4 * dpi)
        assert (picture == 255).mean() == pytest.approx(0.5, abs=2.5 / (4 * dpi))


def test_subpixel_sites_are_averaged(tmp_path):
    # Half of white light is the sRGB value 188; the mean of values 0 and 1 has the colour of 0.5.
    for by, expected in ((CHEQUERED[:, None] * np.ones(3), (188, 188, 188)), (CHEQUERED * 1.0, (33, 145, 140))):
        axes = plot_layout(MANY, by, scale_bar=False, legend=False, ax=bare_axes(0.2, 0.2))
        picture = render_pixels(axes, tmp_path)

        assert picture.shape[:2] == (20, 20)
        # Pixels of 3.2 sites a side have up to 5 per cent more of one value.
        assert np.abs(picture.astype(int) - expected).max() <= 8


def test_inverted_axes_flip_image(tmp_path):
    colours = np.where(MANY.centroid_um[:, :1] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    axes = plot_layout(MANY, colours, scale_bar=False, ax=bare_axes(4, 4))
    axes.invert_xaxis()
    picture = render_pixels(axes, tmp_path)

    assert np.all(picture[:, :199] == [255, 0, 0])
    assert np.all(picture[:, 201:] == [0, 0, 255])


def test_image_cache_survives_recolouring():
    axes = plot_layout(MANY, np.zeros((MANY.n_sites, 3)), ax=bare_axes())
    (image,) = axes.images
    assert isinstance(image, SiteImage)
    axes.figure.draw_without_rendering()
    first = image.pixels
    image.recolour(colours_of(MANY, CHEQUERED == 0))
    axes.figure.draw_without_rendering()
    assert image.pixels is first
    axes.set_xlim(0, 10)
    axes.figure.draw_without_rendering()

    assert image.pixels is not first


@pytest.mark.parametrize("extension", ["pdf", "svg"])
def test_image_embeds_in_vector_files(tmp_path, extension):
    save_figure(plot_layout(MANY, "row", figure_inches=3.0).figure, tmp_path / f"plot.{extension}")

    assert (tmp_path / f"plot.{extension}").stat().st_size > 5000


# -- annotations ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", [LAYOUT, MANY], ids=["outlines", "image"])
@pytest.mark.parametrize("is_drawn", [False, True])
def test_status_bar_shows_site_under_mouse(layout, is_drawn):
    axes = layout.plot(np.arange(layout.n_sites) * 1.5, label="charge / e-")
    if is_drawn:
        axes.figure.draw_without_rendering()
        assert all(image.pixels is not None for image in axes.images)
    site = layout.n_sites - 1
    x, y = layout.centroid_um[site]

    size_um = {2: "4", 4096: "2"}[layout.n_sites]
    assert axes.format_coord(x, y).endswith(f": site {site}, size {size_um} µm, charge {site * 1.5:g} e-")
    assert axes.format_coord(x + 1000.0, y) == f"x = {x + 1000.0:.6g} µm, y = {y:.6g} µm"


@pytest.mark.parametrize(
    ("limit_um", "expected_um"),
    [(0.7, 0.5), (1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (4.9, 2.0), (50.0, 50.0), (999.0, 500.0), (2e4, 2e4)],
)
def test_scale_bar_length_is_round(limit_um, expected_um):
    assert nice_length_um(limit_um) == pytest.approx(expected_um, rel=1e-12)


@pytest.mark.parametrize(("length_um", "text"), [(0.2, "200 nm"), (1.0, "1 µm"), (500.0, "500 µm"), (5000.0, "5 mm")])
def test_scale_bar_unit_matches_length(length_um, text):
    assert format_length(length_um) == text


@pytest.mark.parametrize("zoom", [1.0, 0.1, 0.013])
def test_scale_bar_length_matches_label(tmp_path, zoom):
    axes = plot_layout(MANY, np.ones((MANY.n_sites, 3)), ax=bare_axes(6, 6))
    axes.set_xlim(-64.0 * zoom, 64.0 * zoom)
    axes.set_ylim(-64.0 * zoom, 64.0 * zoom)
    picture = render_pixels(axes, tmp_path)
    rows = np.all(picture == 0, axis=-1)
    length_px = rows.sum(axis=1).max()

    assert length_px * 128.0 * zoom / 600 == pytest.approx(nice_length_um(32.0 * zoom), rel=0.02)


def test_colour_bar_and_legend_contents():
    layout = fs.layout.mosaic(fs.layout.log_polar(n_sectors=8, min_size_um=1.0, r_max_um=4.3), ("RG", "GB"))
    sized = layout.plot("area_um2")
    (bar,) = [axes for axes in sized.figure.axes if axes is not sized]
    assert bar.get_ylabel() == "area / µm²"
    assert bar.get_ylim() == pytest.approx((layout.area_um2.min(), layout.area_um2.max()))

    assert len(layout.plot("area_um2", legend=False).figure.axes) == 1

    kinds = layout.plot("channel")
    assert len(kinds.figure.axes) == 1
    assert kinds.get_legend().get_title().get_text() == "filter"
    assert [text.get_text() for text in kinds.get_legend().get_texts()] == ["R", "G", "B"]

    lines = layout.with_columns(readout_line=np.arange(layout.n_sites)).plot("readout_line")
    assert lines.get_title() == f"readout line: {layout.n_sites} in 10 colours"


def test_readout_lines_follow_readout_order():
    layout = fs.layout.readout_by(fs.layout.grid(n_x=3, n_y=4, pitch_um=2.0), "column")
    axes = layout.plot(overlay="readout_lines")
    lines = axes.collections[1].get_segments()

    assert len(lines) == 3
    assert [line.tolist() for line in lines] == [[[x, y] for y in (3, 1, -1, -3)] for x in (-2, 0, 2)]
    assert axes.collections[2].get_offsets().tolist() == [[x, 3] for x in (-2, 0, 2)]


def test_adjacency_draws_shared_edges():
    axes = fs.layout.grid(n_x=3, n_y=4, pitch_um=2.0).plot(overlay=["adjacency"])
    segments = np.array(axes.collections[1].get_segments())

    assert segments.shape == (2 * 4 + 3 * 3, 2, 2)
    assert np.allclose(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1), 2.0)


# -- colours -------------------------------------------------------------------------------------------------------


def test_mosaic_drawn_in_filter_colours(mosaic_capture):
    axes = mosaic_capture.plot()
    colours = axes.collections[0].get_facecolor()[:, :3]

    # The channel of the filter is the strongest of the three.
    assert np.array_equal(colours.argmax(axis=1), mosaic_capture.layout.channel)
    assert np.array_equal(
        site_colours(mosaic_capture, "channel"), [FILTER_COLOURS["RGB"[c]] for c in mosaic_capture.layout.channel]
    )
    (bar,) = [other for other in axes.figure.axes if other is not axes]
    assert bar.get_ylabel() == "code / DN"
    assert bar.get_ylim() == (0.0, mosaic_capture.code.max())


def test_brightest_mosaic_site_has_filter_colour(mosaic_capture):
    brightest = int(mosaic_capture.electrons.argmax())

    expected = FILTER_COLOURS["RGB"[mosaic_capture.layout.channel[brightest]]]
    assert tuple(site_colours(mosaic_capture, "electrons")[brightest]) == expected


def test_colour_map_monotonic_nan_distinct():
    layout = fs.layout.grid(n_x=256, n_y=1, pitch_um=1.0)
    values = np.arange(256.0)
    values[7] = np.nan
    rgb = site_colours(layout, values).astype(int)
    luminance = np.delete(rgb @ [2126, 7152, 722], 7)

    assert np.all(np.diff(luminance) >= -7152)  # a byte's step: colours are rounded
    assert luminance[-1] > luminance[0] + 1_000_000
    assert tuple(rgb[7]) == NO_DATA
    assert np.abs(np.delete(rgb, 7, axis=0) - NO_DATA).sum(axis=1).min() > 60


def test_equal_values_share_one_colour():
    shown = colours_of(MANY, np.full(MANY.n_sites, 3.0))

    assert np.unique(shown.rgb, axis=0).shape == (1, 3)
    assert (shown.scale.low, shown.scale.high) == (2.5, 3.5)
    assert np.all(colours_of(MANY, np.full(MANY.n_sites, np.nan)).rgb == NO_DATA)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        (np.arange(6) % 2 == 0, ["False", "True"]),
        (np.array(list("abcabc")), ["a", "b", "c"]),
        (np.array([3, 3, 5, 5, 3, 3]), ["3", "5"]),
    ],
    ids=["booleans", "strings", "integers"],
)
def test_categories_have_colours_and_legend(values, names):
    layout = fs.layout.grid(n_x=6, n_y=1, pitch_um=1.0).with_columns(kind=values)
    shown = colours_of(layout, "kind")
    legend = dict(shown.legend)

    assert list(legend) == names
    assert len(set(legend.values())) == len(names)
    assert [tuple(c) for c in shown.rgb.tolist()] == [legend[str(v)] for v in values]
    assert shown.scale is None


def test_readout_line_colours_independent_of_subset():
    layout = fs.layout.readout_by(fs.layout.grid(n_x=30, n_y=2, pitch_um=1.0), "column")

    rgb = site_colours(layout, "readout_line")
    assert np.array_equal(site_colours(layout[layout.readout_line > 11], "readout_line"), rgb[layout.readout_line > 11])
    assert np.array_equal(rgb, np.array(CATEGORY_COLOURS)[layout.readout_line % 10])


def test_bare_layout_neighbours_mostly_differ():
    rgb = site_colours(fs.layout.grid(n_x=50, n_y=40, pitch_um=1.0)).reshape(40, 50, 3).astype(int)

    # With five random shades, 4 of 5 pairs differ.
    assert np.any(np.diff(rgb, axis=1), axis=-1).mean() > 0.75
    assert np.any(np.diff(rgb, axis=0), axis=-1).mean() > 0.75


# -- design rules --------------------------------------------------------------------------------------------------


def test_report_plot_shows_every_violation():
    layout = fs.Layout.from_rectangles([[0, 0], [10, 0], [10.5, 6], [20, 0]], [[4, 4], [0.5, 4], [4, 4], [1, 1]])
    rules = fs.DesignRules(min_width_um=0.8, min_size_um=1.8, max_sites=3, waivers={"min_size_um": "test pixels"})
    report = layout.check(rules)
    axes = report.plot(layout)
    by_label = {c.get_label(): c for c in axes.collections if not c.get_label().startswith("_")}

    assert list(by_label) == [str(result) for result in report.results if len(result)]
    for result in report.results:
        if len(result):
            records = [record for record in report.records() if record["rule"] == result.rule]
            offsets = np.asarray(by_label[str(result)].get_offsets())
            assert np.allclose(offsets, [[p["x_um"], p["y_um"]] for p in records])
    colours = {tuple(c.get_edgecolor()[0]) for c in by_label.values()}
    assert len(colours) == len(by_label)
    labels = {text.get_text() for text in axes.texts}
    assert {"0.5 µm", "1 µm", "1.41 µm"} <= labels
    assert axes.get_title() == "4 violations on 4 photosites, 0 of 3 rules satisfied"
    waived = next(c for label, c in by_label.items() if "waived" in label)
    assert waived.get_linestyle()[0][1] is not None


def test_report_plot_without_layout():
    checked = LAYOUT.check(fs.DesignRules(min_width_um=3.0))
    report = replace(checked, layout=None)  # as from a file
    axes = plot_report(report)

    assert len(report.violations) == 2
    x, y = np.asarray([[r["x_um"], r["y_um"]] for r in report.records()]).T
    assert axes.get_xlim()[0] < x.min() <= x.max() < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < y.min() <= y.max() < axes.get_ylim()[1]
    with pytest.raises(ParameterError, match="'layout' must be the checked layout of 2 sites"):
        report.plot(MANY)
    assert len(axes.collections) < len(checked.plot().collections)
    assert checked.plot().get_xlim() == (0.0, 12.0)


def test_report_plot_without_violations(tmp_path):
    axes = LAYOUT.check(fs.DesignRules(min_size_um=1.0)).plot(LAYOUT)

    assert axes.get_title() == "0 violations on 2 photosites, 1 of 1 rules satisfied"
    assert axes.get_legend() is None
    save_figure(axes.figure, tmp_path / "report.png", dpi=50)


def test_report_plot_limits_violations(tmp_path):
    report = MANY.check(fs.DesignRules(min_size_um=3.0))
    axes = report.plot(MANY)

    circles = axes.collections[-1]
    assert len(circles.get_offsets()) == 2000 < len(report.violations) == 4096
    assert circles.get_label().endswith("(the worst 2,000 are drawn)")
    assert not axes.texts
    save_figure(axes.figure, tmp_path / "report.png", dpi=50)


# -- drawings ------------------------------------------------------------------------------------------------------


def test_drawing_paths_match_plot_colours(tmp_path, mosaic_capture):
    save_drawing(mosaic_capture, tmp_path / "capture.svg", "electrons")
    paths = list(ET.parse(tmp_path / "capture.svg").iter("{http://www.w3.org/2000/svg}path"))

    assert [path.get("fill") for path in paths] == [
        "#" + bytes(rgb.tolist()).hex() for rgb in site_colours(mosaic_capture, "electrons")
    ]
    x0, y0, *_ = mosaic_capture.layout.xy_um[0]
    assert re.match(rf"M{x0:.4f} {y0:.4f}L", paths[0].get("d"))


def test_oversized_drawing_raises_without_output(tmp_path):
    with pytest.raises(ParameterError, match="'data' must have at most 20,000 sites for a drawing, got 20,022"):
        save_drawing(fs.layout.grid(n_x=142, n_y=141, pitch_um=1.0), tmp_path / "layout.svg")
    with pytest.raises(FileError, match=r"must end in \.svg"):
        save_drawing(LAYOUT, tmp_path / "layout.png")

    assert not list(tmp_path.iterdir())


# -- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"by": 3.0}, "'by' must have one row for each of the 2 sites"),
        ({"by": np.ones(3)}, "'by' must have one row for each of the 2 sites"),
        ({"by": np.ones((5, 3))}, "'by' must have one row for each of the 2 sites"),
        ({"by": np.ones((2, 4))}, "'by' must have one row for each of the 2 sites"),
        ({"by": [[1.0], [1.0, 2.0]]}, "'by' must have one value for each site"),
        ({"by": [1j, 2.0]}, "'by' must be an array of numbers"),
        ({"by": np.array([1.0, np.inf])}, "'by' must be finite everywhere, or NaN"),
        ({"by": np.full((2, 3), np.nan)}, "'by' must be finite everywhere"),
        (
            {"by": "code"},
            "'by' must be the name of a column, got 'code'; possible: 'area_um2', 'channel', 'readout_line', 'size_um'",
        ),
        ({"overlay": "lines"}, "'overlay' must be one of 'readout_lines', 'adjacency'"),
        ({"overlay": "readout_lines"}, "'readout_line' must be a column of the layout"),
    ],
)
def test_invalid_plot_arguments_raise(arguments, message):
    with pytest.raises(ParameterError, match=message):
        plot_layout(LAYOUT, **arguments)


def test_adjacency_of_many_sites_raises():
    with pytest.raises(ParameterError, match="'overlay' must not be 'adjacency' above 50,000 sites, got 50,176"):
        plot_layout(fs.layout.grid(n_x=224, n_y=224, pitch_um=1.0), overlay="adjacency")


def test_colours_of_other_types_raises():
    with pytest.raises(ParameterError, match="'data' must be a Layout or a Capture, got a dict"):
        colours_of({})


def test_unknown_format_raises_without_output(tmp_path):
    with pytest.raises(FileError, match="cannot be written in this format"):
        save_figure(plot_layout(LAYOUT).figure, tmp_path / "plot.xyz")

    assert not list(tmp_path.iterdir())


def test_noise_budget_has_dots_per_source():
    layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=2.0)
    sensor = fs.Sensor(layout, read_noise_e=[3.0, 3.0, 5.0, 5.0], prnu_fraction=0.01)
    noise_e = fs.sensor.noise_budget(sensor, np.full(4, 400.0), 1.0)

    together = plot_noise_budget(noise_e)
    grouped = plot_noise_budget(noise_e, classes=[0, 0, 1, 1])

    names = [text.get_text() for text in together.get_yticklabels()]
    assert names == ["photon_shot", "read", "quantisation", "prnu"]
    (dots,) = together.lines
    assert dots.get_xdata()[:2] == pytest.approx([20.0 * np.sqrt(sensor.response.mean()), np.sqrt(17.0)])
    assert [line.get_xdata()[1] for line in grouped.lines] == pytest.approx([3.0, 5.0])
    assert together.get_ylim()[0] > together.get_ylim()[1]
    with pytest.raises(ParameterError, match="'classes' must have one value for each of the 4 sites"):
        plot_noise_budget(noise_e, classes=[0, 1])


def test_sizes_within_rounding_share_one_colour():
    layout = fs.layout.grid(n_x=20, n_y=20, pitch_um=0.1).rotate(17.0)

    assert np.ptp(layout.area_um2) > 0.0
    assert np.ptp(site_colours(layout, "area_um2"), axis=0).max() <= 1
