"""Plots of scenes, power maps, pictures and results: positions, units, colours."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim import metrics
from foveasim.errors import ParameterError
from foveasim.view import plot_curves, plot_picture
from foveasim.view.plots.rasters import block_means, power_map_pixels, scene_pixels

GRID = fs.Grid((20, 40), 0.5, (-3.0, -2.0))


def scene_of(pixels, **options):
    given = {"pitch_um": 50.0, "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 0.05, "encoding": "linear"} | options
    return fs.Scene.from_picture(np.asarray(pixels, np.float32), **given)


def test_scene_plot_is_centred_and_upright():
    pixels = np.zeros((20, 40, 3))
    pixels[:10, :20] = (1.0, 0.0, 0.0)  # upper left
    axes = scene_of(pixels).plot()
    (image,) = axes.images
    shown = image.get_array()

    assert image.get_extent() == [-1.0, 1.0, -0.5, 0.5]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x / mm", "y / mm")
    assert shown[0, 0].argmax() == 0
    assert shown[0, 0, 0] == 255
    assert not shown[-1].any()
    assert not shown[:, -1].any()


@pytest.mark.parametrize(("pitch_um", "unit"), [(0.5, "µm"), (100.0, "mm"), (1e6, "m"), (1e9, "km")])
def test_scene_plot_selects_unit(pitch_um, unit):
    scene = scene_of(np.ones((20, 40)), pitch_um=pitch_um, band_width_nm=10.0)

    assert scene.plot().get_xlabel() == f"x / {unit}"


def test_scene_colours_of_equal_radiance_are_white():
    for n in (1, 3, 31):
        scene = fs.Scene.flat(
            shape=(8, 8), pitch_um=50.0, distance_m=0.5, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0,
            wavelength_nm=np.linspace(620.0, 450.0, n).tolist(),
        )  # fmt: skip
        assert np.all(scene_pixels(scene, 8) == 255)


@pytest.mark.parametrize(("wavelength_nm", "channel"), [(630.0, 0), (535.0, 1), (455.0, 2)])
def test_bands_have_the_colour_of_their_wavelength(wavelength_nm, channel):
    waves_nm = [630.0, 535.0, 455.0]
    data = np.array([np.full(GRID.shape, float(nm == wavelength_nm)) for nm in waves_nm])
    pixels = power_map_pixels(fs.PowerMap(data, GRID, np.array(waves_nm)), 100)

    assert np.all(pixels.argmax(axis=-1) == channel)
    infrared = fs.PowerMap(data, GRID, np.array([850.0, 900.0, 950.0]))
    assert np.all(np.ptp(power_map_pixels(infrared, 100), axis=-1) == 0)


def test_power_map_plot_sums_bands():
    data = np.zeros((2, *GRID.shape))
    data[0, 0, 0], data[1, -1, -1] = 2.0, 3.0
    power_map = fs.PowerMap(data, GRID, np.array([500.0, 600.0]))
    total, second = power_map.plot(), power_map.plot(1)

    assert total.images[0].get_extent() == [-3.0, 17.0, -2.0, 8.0]
    values = np.asarray(total.images[0].get_array())
    assert values[-1, 0] == 2.0  # the lowest row is drawn last
    assert values[0, -1] == 3.0
    assert values.sum() == 5.0
    assert np.asarray(second.images[0].get_array()).sum() == 3.0
    assert [other.get_ylabel() for other in second.figure.axes][1] == "irradiance at 600 nm / (W/m²)"
    with pytest.raises(ParameterError, match=r"'band' must be .*<= 1, got 2"):
        power_map.plot(2)


def test_large_power_map_is_averaged():
    power_map = fs.PowerMap(np.ones((1, 10, 4001)), fs.Grid((10, 4001), 0.5), np.array([500.0]))
    values = np.asarray(power_map.plot().images[0].get_array())

    assert max(values.shape) <= 1600
    assert np.all(values == 1.0)


def test_block_means_ignore_missing_data():
    image = np.array([[[1.0, np.nan, 4.0, 4.0, 9.0], [3.0, np.nan, 4.0, 8.0, 9.0], [0, 0, 0, 0, 0]]], np.float32)

    assert block_means(image, 3).tolist() == [[[2.0, 5.0]]]
    assert np.isnan(block_means(np.full((1, 4, 4), np.nan), 2)).all()
    assert block_means(image, 5) is image


def test_picture_plot_shows_values_and_colours():
    data = np.arange(2400, dtype=np.float32).reshape(3, 20, 40)
    data[:, 0] = np.nan
    picture = fs.Picture(data, (~np.isnan(data[0])).astype(np.float32), GRID)
    colours, channel = picture.plot(), picture.plot(channel=2)

    assert colours.images[0].get_extent() == [-3.0, 17.0, -2.0, 8.0]
    assert np.array_equal(colours.images[0].get_array(), picture.to_image())
    shown = channel.images[0].get_array()
    assert np.array_equal(np.ma.filled(shown, np.nan), data[2, ::-1], equal_nan=True)
    with pytest.raises(ParameterError, match="'channel' must be given for a picture of 2 channels"):
        plot_picture(fs.Picture(data[:2], picture.coverage, GRID))
    with pytest.raises(ParameterError, match=r"'channel' must be .*<= 2, got 3"):
        picture.plot(channel=3)


# -- results ---------------------------------------------------------------------------------------------------------


def test_results_are_drawn_as_curves():
    frequency = np.linspace(0.0, 100.0, 50)
    edge = metrics.EdgeMtf(
        frequency_per_mm=frequency, mtf=1.0 - 0.01 * frequency, mtf_sigma=0.0 * frequency, angle_deg=5.0, offset_um=0.0,
        contrast=1.0, bin_um=0.5, pitch_um=2.0, distance_um=frequency, esf=frequency, n_sites=50,
    )  # fmt: skip
    (line,) = edge.plot().lines
    assert np.array_equal(line.get_xydata(), np.stack((frequency, 1.0 - 0.01 * frequency), axis=1))

    transfer = metrics.PhotonTransfer(
        np.array([1, 2]), np.ones(2, int), np.ones(3, int), *np.arange(18.0).reshape(3, 3, 2)
    )
    axes = transfer.plot()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["class 1", "class 2"]
    assert np.array_equal(axes.lines[1].get_ydata(), transfer.temporal_variance_dn2[:, 1])
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")

    table = metrics.nyquist_vs_eccentricity(fs.layout.log_polar(24, r_max_um=54.7, min_size_um=2.0), n_bins=4)
    lines = {line.get_label(): line.get_ydata() for line in table.plot().lines}
    assert np.array_equal(lines["median"], table.nyquist_per_mm, equal_nan=True)
    assert list(lines) == ["highest", "median", "lowest"]

    spectrum = metrics.sampling_spectrum(fs.layout.grid(20, 20, 2.0))
    (line,) = spectrum.plot().lines
    assert np.array_equal(line.get_ydata(), spectrum.radial()[1], equal_nan=True)

    snr = metrics.SnrTable(
        classes=np.arange(3), n_sites=np.ones(3, int), size_um=np.array([1.0, 2.0, 4.0]), signal_dn=np.array([5.0, 6.0, 9.0]),
        noise_dn=np.array([1.0, 2.0, 3.0]), saturated_fraction=np.zeros(3),
    )  # fmt: skip
    (line,) = snr.plot().lines
    assert line.get_xydata().tolist() == [[1.0, 5.0], [2.0, 3.0], [4.0, 3.0]]


def test_curves_need_known_scale():
    with pytest.raises(ParameterError, match="'logarithmic' must be one of '', 'x', 'y', 'xy', got 'z'"):
        plot_curves({"": ([1], [2])}, "x", "y", logarithmic="z")


@pytest.mark.parametrize("stagger", [False, True])
def test_log_polar_plot_is_unrolled_exactly(stagger):
    layout = fs.layout.log_polar(n_sectors=12, r_min_um=10.0, r_max_um=40.0, n_rings=5, stagger=stagger)
    degrees = np.degrees(np.arctan2(*layout.centroid_um.T[::-1])) % 360.0
    image = fs.reconstruct.cortical(layout, degrees)
    ax = image.plot()
    (shown,) = (np.asarray(each.get_array()) for each in ax.images)

    assert ax.images[0].get_extent() == [0.0, 360.0, 0.0, 5.0]
    assert ax.get_xlabel() == "angle / degrees"
    assert [label.get_text() for label in ax.get_yticklabels()][::5] == ["10", "40"]
    # Each of the 24 columns shows the site at its angle: the angle of its centroid is at most half a sector away.
    off = (shown - np.arange(7.5, 360.0, 15.0) + 180.0) % 360.0 - 180.0
    assert np.abs(off) == pytest.approx(7.5, abs=1e-9)


def test_colour_log_polar_images_are_white_balanced():
    plane = np.full((40, 40), 0.25, np.float32)
    grey = np.stack((plane, 2.0 * plane, 0.5 * plane))
    picture = fs.Picture(grey, np.ones((40, 40), np.float32), fs.Grid((40, 40), 1.0), np.array([1.0, 2.0, 0.5]))
    image = fs.reconstruct.to_cortical(picture, n_rings=4, n_sectors=16, r_max_um=15.0, centre_um=(20.0, 20.0))
    back = fs.reconstruct.from_cortical(image, picture.grid)
    for ax in (image.plot(), picture.plot(), back.plot()):
        pixels = np.asarray(ax.images[0].get_array())
        assert np.all(pixels[pixels[..., 3] == 255][:, :3] == 255)
    with pytest.raises(ParameterError, match="'channel' must be given for an image of 2 channels"):
        fs.reconstruct.CorticalImage(data=image.data[:2], radius_um=image.radius_um, start_rad=image.start_rad).plot()


def test_colours_without_white_are_balanced_and_scaled():
    data = np.array([[[4.0, 2.0]], [[8.0, 8.0]], [[2.0, 1.0]]], np.float32)
    picture = fs.Picture(data, np.ones((1, 2), np.float32), fs.Grid((1, 2), 1.0), np.array([8.0, 16.0, 4.0]))

    assert picture.to_image(encode_srgb=False)[0].tolist() == [[255, 255, 255, 255], [128, 255, 128, 255]]
    assert picture.to_image(8.0, encode_srgb=False)[0].tolist() == [[128, 255, 64, 255], [64, 255, 32, 255]]
    for white in ([1.0, 2.0], [1.0, 0.0, 1.0]):
        with pytest.raises(ParameterError, match="'white' must be"):
            fs.Picture(data, np.ones((1, 2), np.float32), picture.grid, np.array(white))
