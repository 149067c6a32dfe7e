"""Plots on matplotlib axes: every site drawn where it is, in the colour of what it measured."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.errors import FileError, ParameterError
from foveasim.pictures import read_picture
from foveasim.view import plot_capture, plot_layout, plot_noise_budget, save_figure

FRAME = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(2, 2), (2, 6), (6, 6), (6, 2)]])
LAYOUT = fs.Layout.from_polygons([FRAME, shapely.box(10, 0, 12, 8)])


def drawn(axes, tmp_path):
    """The picture of the axes' inside, which are stretched over the whole figure."""
    axes.set_position((0, 0, 1, 1))
    axes.axis("off")
    axes.figure.set_layout_engine("none")
    save_figure(axes.figure, tmp_path / "plot.png", dpi=100)
    return read_picture(tmp_path / "plot.png")


def test_sites_are_drawn_where_they_are_holes_and_gaps_left_open(tmp_path):
    axes = Figure(figsize=(6, 4), facecolor="white").add_axes((0, 0, 1, 1))
    plot_layout(LAYOUT, colours=np.array([[1.0, 0, 0], [0, 0, 1.0]]), ax=axes)
    picture = drawn(axes, tmp_path)[..., :3]
    red, blue = (np.all(picture == colour, axis=-1).mean() for colour in ([255, 0, 0], [0, 0, 255]))

    # Of the plot's 12 x 8 µm the frame covers 64 - 16 and the box 16.
    assert red == pytest.approx(48 / 96, abs=0.02)
    assert blue == pytest.approx(16 / 96, abs=0.02)
    assert not np.all(picture[200, 200] == [255, 0, 0])


def test_y_points_up(tmp_path):
    low_and_high = fs.Layout.from_rectangles([[0, 0], [0, 2]], 2.0)
    axes = Figure(figsize=(2, 4)).add_axes((0, 0, 1, 1))
    plot_layout(low_and_high, colours=np.array([[0, 0, 0], [1.0, 1, 1]]), ax=axes)
    picture = drawn(axes, tmp_path)[..., 0]

    assert picture[50:150].min() == 255
    assert picture[250:350].max() == 0


def test_a_mosaic_is_drawn_in_the_colours_of_its_filters():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0), ("RG", "GB"))
    sensor = fs.Sensor(layout, filters="rgb", capacitance_f=1e-15)
    scene = fs.Scene.flat(
        shape=(100, 100), pitch_um=20.0, distance_m=0.5, radiance_w_m2_sr_nm=1.0, wavelength_nm=(450, 540, 610)
    )
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor)
    axes = plot_capture(camera.capture(scene, exposure_s=0.01, seed=0))
    colours = axes.collections[0].get_facecolor()[:, :3]

    # The filter's own colour is the strongest of the three.
    assert np.array_equal(colours.argmax(axis=1), layout.channel)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"values": 3.0}, "'values' must have one row for each of the 2 sites"),
        ({"values": np.ones(3)}, "'values' must have one row for each of the 2 sites"),
        ({"colours": np.ones((5, 3))}, "'colours' must have one row for each of the 2 sites"),
        ({"values": np.array([1.0, np.nan])}, "'values' must be finite everywhere"),
    ],
)
def test_values_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        plot_layout(LAYOUT, **arguments)


def test_an_unknown_format_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(FileError, match="cannot be written in this format"):
        save_figure(plot_layout(LAYOUT).figure, tmp_path / "plot.xyz")

    assert not list(tmp_path.iterdir())


def test_a_noise_budget_has_a_bar_for_each_source_and_class():
    layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=2.0)
    sensor = fs.Sensor(layout, read_noise_e=[3.0, 3.0, 5.0, 5.0], prnu_fraction=0.01)
    noise_e = fs.sensor.noise_budget(sensor, np.full(4, 400.0), 1.0)

    together = plot_noise_budget(noise_e)
    apart = plot_noise_budget(noise_e, classes=[0, 0, 1, 1])

    names = [text.get_text() for text in together.get_yticklabels()]
    assert names == ["shot of light", "read", "quantisation", "photo response"]
    widths = [bar.get_width() for bar in together.patches]
    assert widths[0] == pytest.approx(20.0)
    assert widths[1] == pytest.approx(np.sqrt(17.0))
    assert [bar.get_width() for bar in apart.patches][1::4] == pytest.approx([3.0, 5.0])
    with pytest.raises(ParameterError, match="'classes' must be one for each of the 4 sites"):
        plot_noise_budget(noise_e, classes=[0, 1])
