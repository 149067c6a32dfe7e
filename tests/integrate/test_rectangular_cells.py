"""Grids with rectangular cells: symmetry under scaling, clipping with shapely, closed forms, file round trips."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.polygons import POLYGONS

import foveasim as fs
from foveasim._core.provenance import to_plain_data
from foveasim.config import read_shot, schema
from foveasim.distortion import BrownConrady
from foveasim.errors import FileError, ParameterError
from foveasim.maps import from_xarray, read_power_map, to_xarray, write_power_map
from foveasim.metrics import flow_bound, site_gradients_e_per_um
from foveasim.reconstruct import blur_kernel, cells, least_squares, linear, reference

SHAPE = (24, 17)
PITCH = (0.9, 0.35)
GRID = fs.Grid.centred(SHAPE, PITCH)
MAP = np.random.default_rng(8).uniform(0.5, 1.5, SHAPE)
LAYOUTS = {
    "rings": lambda: fs.layout.log_polar(n_sectors=16, r_min_um=0.4, r_max_um=4.5, stagger=True),
    "hexagons": lambda: fs.layout.hexagonal(n_columns=9, n_rows=9, pitch_um=0.8),
    "squares": lambda: fs.layout.grid(n_x=7, n_y=9, pitch_um=1.1),
    "off the grid": lambda: fs.layout.grid(n_x=9, n_y=9, pitch_um=1.3).translate(3.0, 2.0),
    "concave and holes": lambda: fs.Layout.from_polygons(
        [POLYGONS[name] for name in ("star", "U shape", "two holes in a row")]
    ),
}


@cache
def layout_named(name):
    return LAYOUTS[name]()


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return layout_named(request.param)


ORDER = pytest.mark.parametrize("order", [1, 2])
BARREL = BrownConrady(focal_um=20.0, k1=-0.12, k2=0.02, p1=0.03, p2=-0.02)


def scale(layout, sizes):
    return fs.Layout(layout.xy_um * sizes, layout.ring_offsets, layout.site_offsets, layout.columns)


def clipped_um2(layout, grid):
    """Return the overlap area of every site with every cell by GEOS, (n_site, n_y, n_x)."""
    x0, y0, *_ = grid.bounds_um
    left, low = x0 + np.arange(grid.shape[1]) * grid.pitch_x_um, y0 + np.arange(grid.shape[0]) * grid.pitch_y_um
    left, low = np.meshgrid(left, low)
    boxes = shapely.box(left, low, left + grid.pitch_x_um, low + grid.pitch_y_um)
    return shapely.area(shapely.intersection(layout.polygons()[:, np.newaxis, np.newaxis], boxes))


class ScaledLens:
    """Lens in coordinates that are scaled along the axes."""

    def __init__(self, lens, sizes):
        self.lens, self.sizes = lens, np.array(sizes)

    def undistort(self, xy_um, *, outside="error"):
        return self.lens.undistort(np.asarray(xy_um) / self.sizes, outside=outside) * self.sizes


# -- the grid ---------------------------------------------------------------------------------------------------------


def test_grid_takes_pitch_per_axis():
    grid = fs.Grid(shape=(2, 3), pitch_um=(0.5, 2.0), origin_um=(10.0, -4.0))

    assert (grid.pitch_um, grid.pitch_x_um, grid.pitch_y_um, grid.cell_area_um2) == ((0.5, 2.0), 0.5, 2.0, 1.0)
    assert grid.bounds_um == (10.0, -4.0, 11.5, 0.0)
    assert grid.x_um.tolist() == [10.25, 10.75, 11.25]
    assert grid.y_um.tolist() == [-3.0, -1.0]
    assert repr(grid) == "Grid(shape=(2, 3), pitch_um=(0.5, 2.0), origin_um=(10.0, -4.0))"
    assert fs.Grid.centred((2, 3), (0.5, 2.0)).bounds_um == (-0.75, -2.0, 0.75, 2.0)


@pytest.mark.parametrize("pitch", [(2, 2), [2.0, 2.0], np.array([2.0, 2.0]), np.float32(2), 2, np.array(2.0)])
def test_equal_pitches_collapse_to_float(pitch):
    grid = fs.Grid((3, 4), pitch)

    assert type(grid.pitch_um) is float
    assert grid == fs.Grid((3, 4), 2.0)
    assert hash(grid) == hash(fs.Grid((3, 4), 2.0))
    assert fs.Grid.centred((3, 4), pitch) == fs.Grid.centred((3, 4), 2.0)


@pytest.mark.parametrize("pitch", [(0.5, 2), [0.5, 2.0], np.array([0.5, 2.0], np.float32)])
def test_grid_pitch_is_hashable_plain_data(pitch):
    grid = fs.Grid((3, 4), pitch)

    assert grid.pitch_um == (0.5, 2.0)
    assert [type(length_um) for length_um in grid.pitch_um] == [float, float]
    assert pickle.loads(pickle.dumps(grid)) == grid
    assert {grid: 1}[fs.Grid((3, 4), (0.5, 2.0))] == 1
    assert grid != fs.Grid((3, 4), (2.0, 0.5))
    assert to_plain_data(grid) == {"kind": "Grid", "shape": [3, 4], "pitch_um": [0.5, 2.0], "origin_um": [0.0, 0.0]}


@pytest.mark.parametrize(
    ("pitch", "message"),
    [
        ((1.0, 0.0), r"'pitch_um' must be > 0, got 0.0 µm"),
        ((1.0, np.nan), r"'pitch_um' must be finite"),
        ((1.0, 2.0, 3.0), r"'pitch_um' must be one number, or two numbers"),
        ((1.0,), r"'pitch_um' must be one number, or two numbers"),
        (((1.0, 2.0), 3.0), r"'pitch_um' must be one number"),
        ("12", r"'pitch_um' must be one number"),
        (None, r"'pitch_um' must be one number"),
    ],
)
def test_grid_rejects_malformed_pitch(pitch, message):
    for make in (fs.Grid, fs.Grid.centred):
        with pytest.raises(ParameterError, match=message):
            make((3, 4), pitch)


# -- the integrator -----------------------------------------------------------------------------------------------------


@ORDER
def test_integration_is_symmetric_under_scaling(layout, order):
    """Cells of p_x by p_y are equivalent to unit cells with the layout divided by p_x along x and by p_y along y."""
    square = fs.Grid(SHAPE, 1.0, tuple(np.array(GRID.origin_um) / PITCH))
    there = fs.Integrator(layout, GRID, order=order)
    here = fs.Integrator(scale(layout, 1.0 / np.array(PITCH)), square, order=order)
    area = GRID.cell_area_um2

    np.testing.assert_allclose(there(MAP), area * here(MAP), rtol=1e-11, atol=1e-13)
    difference = there.weights() - area * here.weights()
    assert abs(difference).max() < 1e-12
    np.testing.assert_allclose(there.uncovered_um2, area * here.uncovered_um2, rtol=1e-10, atol=1e-12)


def test_weights_agree_with_shapely_clipping(layout):
    overlaps = clipped_um2(layout, GRID)
    integrator = fs.Integrator(layout, GRID)

    weights = integrator.weights().toarray().reshape(overlaps.shape)
    np.testing.assert_allclose(weights, overlaps, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(integrator(MAP), np.tensordot(overlaps, MAP, 2), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(integrator.uncovered_um2, layout.area_um2 - overlaps.sum(axis=(1, 2)), atol=1e-11)


@ORDER
@settings(max_examples=examples(30))
@given(
    pitch=st.tuples(st.floats(0.05, 20.0), st.floats(0.05, 20.0)),
    origin=st.tuples(st.floats(-9.0, 1.0), st.floats(-9.0, 1.0)),
    name=st.sampled_from(["star", "U shape", "two holes in a row"]),
)
def test_any_pitch_agrees_with_shapely_clipping(order, pitch, origin, name):
    layout = fs.Layout.from_polygons([POLYGONS[name]])
    shape = tuple(int(n) for n in np.clip(np.ceil(18.0 / np.array(pitch[::-1])), 1, 60))
    grid = fs.Grid(shape, pitch, origin)
    overlaps = clipped_um2(layout, grid)[0]
    integrator = fs.Integrator(layout, grid, order=order)

    np.testing.assert_allclose(integrator(np.full(shape, 2.5)), 2.5 * overlaps.sum(), rtol=1e-9, atol=1e-12)
    if order == 1:
        np.testing.assert_allclose(integrator.weights().toarray().reshape(shape), overlaps, rtol=1e-8, atol=1e-11)


@ORDER
def test_uniform_map_gives_irradiance_times_area(layout, order):
    grid = fs.Grid.centred((90, 40), PITCH)  # larger than every layout except one
    on_um2 = shapely.area(shapely.intersection(layout.polygons(), shapely.box(*grid.bounds_um)))

    power = fs.Integrator(layout, grid, order=order)(np.full(grid.shape, 3.0))

    np.testing.assert_allclose(power, 3.0 * on_um2, rtol=1e-11, atol=1e-12)


def test_linear_map_is_exact_at_second_order(layout):
    grid = fs.Grid.centred((90, 40), PITCH)
    inside = layout[shapely.covers(shapely.box(*grid.bounds_um), layout.polygons())]
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)

    power = fs.Integrator(inside, grid, order=2)(20.0 + 0.7 * x_um - 0.4 * y_um)

    mean = 20.0 + inside.centroid_um @ [0.7, -0.4]
    np.testing.assert_allclose(power, mean * inside.area_um2, rtol=1e-11)
    assert inside.n_sites > 0


@ORDER
def test_spread_is_adjoint_of_operator(layout, order):
    integrator = fs.Integrator(layout, GRID, order=order)
    values = np.random.default_rng(2).normal(size=layout.n_sites)

    assert (integrator.spread(values) * MAP).sum() == pytest.approx(values @ integrator(MAP), rel=1e-11)
    np.testing.assert_allclose(integrator.weights().T @ values, integrator.spread(values).ravel(), atol=1e-12)
    row_sums = np.asarray(integrator.weights().sum(axis=1)).ravel()
    np.testing.assert_allclose(row_sums, layout.area_um2 - integrator.uncovered_um2, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("name", "repeats"), [("wide", (1, 3)), ("high", (3, 1))])
@pytest.mark.parametrize("conserve", ["flux", "density"])
def test_distorted_rectangular_cells_equal_repeated_squares(name, repeats, conserve):
    """A cell of three squares is equivalent to three squares of equal value, with identical undistorted outlines."""
    del name
    layout = layout_named("rings")
    coarse = fs.Grid.centred((20, 22), (0.7 * repeats[1], 0.7 * repeats[0]))
    fine = fs.Grid.centred((20 * repeats[0], 22 * repeats[1]), 0.7)
    values = np.random.default_rng(3).uniform(0.5, 1.5, coarse.shape)
    repeated = np.repeat(np.repeat(values, repeats[0], axis=0), repeats[1], axis=1)
    there, here = (fs.Integrator(layout, grid, distortion=BARREL, conserve=conserve) for grid in (coarse, fine))

    np.testing.assert_allclose(there(values), here(repeated), rtol=1e-11)
    folded = here.spread(np.ones(layout.n_sites)).reshape(20, repeats[0], 22, repeats[1]).sum(axis=(1, 3))
    np.testing.assert_allclose(there.spread(np.ones(layout.n_sites)), folded, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(there.uncovered_um2, here.uncovered_um2, atol=1e-12)


@ORDER
def test_distorted_integration_is_symmetric_under_scaling(order):
    layout, sizes = layout_named("rings"), np.array([2.5, 0.4])
    square = fs.Grid.centred((60, 60), 0.2)
    grid = fs.Grid.centred((60, 60), tuple(0.2 * sizes))
    values = np.random.default_rng(4).uniform(0.5, 1.5, square.shape)
    here = fs.Integrator(layout, square, distortion=BARREL, order=order)
    there = fs.Integrator(scale(layout, sizes), grid, distortion=ScaledLens(BARREL, sizes), order=order)

    # The chords differ: their error is up to 0.2 % of the shorter side of a cell.
    np.testing.assert_allclose(there(values), here(values) * sizes.prod(), rtol=2e-4)


def test_distorted_map_is_independent_of_cell_shape():
    """Nearest-cell interpolation of rectangular cells equals that of squares with repeated values."""
    coarse, fine = fs.Grid.centred((30, 12), (0.9, 0.3)), fs.Grid.centred((30, 36), 0.3)
    values = np.random.default_rng(5).uniform(0.5, 1.5, coarse.shape)
    maps = [
        fs.PowerMap(data[np.newaxis], grid, np.array([550.0]))
        for data, grid in ((values, coarse), (np.repeat(values, 3, axis=1), fine))
    ]
    onto = fs.Grid.centred((40, 9), (1.1, 0.2))

    there, here = (fs.distortion.distort_map(light, BARREL, grid=onto, order=0) for light in maps)

    np.testing.assert_array_equal(there.data, here.data)
    assert there.grid == onto


def test_distorted_map_conserves_power_of_rectangular_cells():
    light = fs.PowerMap.from_array(np.ones((60, 30)), pitch_um=(0.4, 0.2), wavelength_nm=550.0)
    distorted = fs.distortion.distort_map(light, BARREL)

    assert distorted.grid.pitch_um == (0.4, 0.2)
    power = [float(m.data.sum() * m.grid.cell_area_um2) for m in (light, distorted)]
    assert power[1] == pytest.approx(power[0], rel=0.03)  # boundary cells are either included or excluded


def test_ideal_lens_leaves_rectangular_map_unchanged():
    light = fs.PowerMap.from_array(MAP, pitch_um=PITCH, wavelength_nm=550.0, origin_um=(-3.0, -2.0))
    same = fs.distortion.distort_map(light, BrownConrady(focal_um=100.0))

    assert same.grid.shape == light.grid.shape
    np.testing.assert_allclose(same.grid.bounds_um, light.grid.bounds_um, atol=1e-9)
    np.testing.assert_allclose(same.data, light.data, rtol=1e-9)


def test_camera_takes_maps_of_rectangular_cells():
    layout = fs.layout.grid(n_x=6, n_y=5, pitch_um=1.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout))
    coarse = fs.PowerMap.from_array(MAP, pitch_um=(0.9, 0.3), wavelength_nm=550.0)
    fine = fs.PowerMap.from_array(np.repeat(MAP, 3, axis=1), pitch_um=0.3, wavelength_nm=550.0)

    np.testing.assert_allclose(camera.photoelectrons_per_s(coarse), camera.photoelectrons_per_s(fine), rtol=1e-11)
    capture = camera.capture(coarse, exposure_s=1e-3, seed=0)
    assert capture.settings["light"]["grid"]["pitch_um"] == [0.9, 0.3]


# -- files --------------------------------------------------------------------------------------------------------------


def rectangular_map():
    rng = np.random.default_rng(6)
    grid = fs.Grid((5, 7), (0.3, 1.7), (-1.23456789, 0.1))
    return fs.PowerMap(rng.random((2, 5, 7), dtype=np.float32), grid, np.array([450.0, 620.5]))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("extension", ["npz", "fits", "tif", "exr", "nc", "zarr"])
def test_files_round_trip_rectangular_cells(tmp_path, extension):
    light = rectangular_map()
    write_power_map(light, tmp_path / f"map.{extension}")

    read = read_power_map(tmp_path / f"map.{extension}")

    assert read.grid == light.grid
    np.testing.assert_array_equal(read.data, light.data)
    np.testing.assert_array_equal(read.wavelength_nm, light.wavelength_nm)


def test_labelled_array_round_trips_rectangular_cells():
    light = rectangular_map()
    array = to_xarray(light)

    assert array.attrs["pitch_um"] == [0.3, 1.7]
    np.testing.assert_allclose(array["y"], 0.1 + 1.7 * (np.arange(5) + 0.5))
    assert from_xarray(array).grid == light.grid
    part = from_xarray(array.isel(x=slice(2, 5), y=slice(1, 3)))
    np.testing.assert_allclose(part.grid.pitch_um, (0.3, 1.7))
    np.testing.assert_allclose(part.grid.origin_um, (-1.23456789 + 0.6, 0.1 + 1.7))


def test_fits_axes_specify_both_pitches(tmp_path):
    """Standard keywords CDELT, CRPIX and CRVAL in mm and µm, with a descending row axis."""
    from astropy.io import fits

    header = fits.Header(
        {"CUNIT1": "mm", "CDELT1": 2e-3, "CRPIX1": 1.0, "CRVAL1": 0.05}
        | {"CUNIT2": "um", "CDELT2": -0.5, "CRPIX2": 3.0, "CRVAL2": 7.0, "BUNIT": "W m-2"}
    )
    fits.writeto(tmp_path / "map.fits", np.arange(12.0).reshape(3, 4), header)

    read = read_power_map(tmp_path / "map.fits", wavelength_nm=550.0)

    # Centres along x: 50, 52, 54, 56 µm. Row 3 has its centre at 7 µm, rows 2 and 1 at 7.5 and 8 µm.
    np.testing.assert_allclose(read.grid.pitch_um, (2.0, 0.5))
    np.testing.assert_allclose(read.grid.x_um, [50.0, 52.0, 54.0, 56.0])
    np.testing.assert_allclose(read.grid.y_um, [7.0, 7.5, 8.0])
    np.testing.assert_array_equal(read.data[0], np.arange(12.0).reshape(3, 4)[::-1])


def test_fits_pixel_sizes_specify_both_pitches(tmp_path):
    from astropy.io import fits

    fits.writeto(tmp_path / "map.fits", np.ones((3, 4)), fits.Header({"XPIXSZ": 2.0, "YPIXSZ": 3.5, "BUNIT": "W m-2"}))

    read = read_power_map(tmp_path / "map.fits", wavelength_nm=550.0)

    assert read.grid == fs.Grid.centred((3, 4), (2.0, 3.5))


def test_netcdf_coordinates_specify_both_pitches(tmp_path):
    import xarray as xr

    light = xr.DataArray(
        np.arange(12.0).reshape(3, 4),
        dims=("y", "x"),
        coords={
            "y": ("y", np.array([9.0, 6.0, 3.0], np.float32), {"units": "um"}),
            "x": ("x", np.arange(4) * 1e-6, {"units": "m"}),
        },
        attrs={"units": "W m-2"},
        name="irradiance",
    )
    light.to_dataset().to_netcdf(tmp_path / "map.nc", engine="h5netcdf")

    read = read_power_map(tmp_path / "map.nc", wavelength_nm=550.0)

    np.testing.assert_allclose(read.grid.pitch_um, (1.0, 3.0))
    np.testing.assert_allclose(read.grid.bounds_um, (-0.5, 1.5, 3.5, 10.5))
    np.testing.assert_array_equal(read.data[0], np.arange(12.0).reshape(3, 4)[::-1])


def test_float32_coordinates_yield_square_cells():
    import xarray as xr

    array = xr.DataArray(
        np.ones((5, 9)),
        dims=("y", "x"),
        coords={
            name: (name, np.float32(0.1) * np.arange(n, dtype=np.float32), {"units": "um"})
            for name, n in (("y", 5), ("x", 9))
        },
        attrs={"units": "W m-2"},
    )

    assert isinstance(from_xarray(array, wavelength_nm=550.0).grid.pitch_um, float)


def test_arguments_specify_both_pitches(tmp_path):
    np.save(tmp_path / "map.npy", np.ones((3, 4)))
    np.savez(tmp_path / "map.npz", data=np.ones((3, 4)), pitch_um=[0.5, 2.0])
    given_values = {"wavelength_nm": 550.0, "unit": "w_m2"}

    read = read_power_map(tmp_path / "map.npy", pitch_um=(0.5, 2.0), **given_values)

    assert read.grid == fs.Grid.centred((3, 4), (0.5, 2.0))
    assert read_power_map(tmp_path / "map.npz", **given_values).grid == read.grid
    with pytest.raises(ParameterError, match="'pitch_um' must be one number, or two numbers"):
        read_power_map(tmp_path / "map.npy", pitch_um=(1.0, 2.0, 3.0), **given_values)


@pytest.mark.parametrize("pitch", [[0.0, 1.0], [1.0, np.nan], [1.0, -2.0]])
def test_file_rejects_pitch_out_of_range(tmp_path, pitch):
    np.savez(tmp_path / "map.npz", data=np.ones((3, 4)), pitch_um=pitch)

    with pytest.raises(FileError, match=r"map\.npz: has a cell size outside the allowed range"):
        read_power_map(tmp_path / "map.npz", wavelength_nm=550.0, unit="w_m2")


def test_settings_file_takes_both_pitches(tmp_path):
    np.save(tmp_path / "map.npy", np.ones((30, 40)))
    (tmp_path / "shot.yaml").write_text(
        "scene: {kind: power_map, path: map.npy, pitch_um: [0.5, 2], wavelength_nm: 550, unit: w_m2}\n"
        "optics: {focal_length_mm: 8.0, f_number: 2.8}\n"
        "layout: {generator: grid, parameters: {n_x: 4, n_y: 4, pitch_um: 2.0}}\n"
        "exposure_s: 0.01\n"
    )

    assert read_shot(tmp_path / "shot.yaml").scene.grid == fs.Grid.centred((30, 40), (0.5, 2.0))
    pitch = schema()["$defs"]["power_map_kind"]["properties"]["pitch_um"]
    assert {kind["type"] for kind in pitch["anyOf"]} == {"number", "array", "null"}


# -- other uses of grids --------------------------------------------------------------------------------------------------


def test_reference_averages_over_rectangular_pixels():
    light = fs.PowerMap.from_array(MAP, pitch_um=PITCH, wavelength_nm=550.0)
    pixels = fs.Grid.centred((6, 5), (1.3, 0.8))
    layout = fs.Layout.from_rectangles(
        np.stack(np.meshgrid(pixels.x_um, pixels.y_um), axis=-1).reshape(-1, 2), np.array([[1.3, 0.8]] * 30)
    )
    overlaps = clipped_um2(layout, light.grid).reshape(30, *SHAPE)

    picture = reference(light, pixels)

    expected = np.tensordot(overlaps, MAP, 2) / overlaps.sum(axis=(1, 2))
    np.testing.assert_allclose(picture.data[0].ravel(), expected, rtol=1e-6)


@pytest.mark.parametrize("method", [cells, linear])
def test_uniform_values_fill_rectangular_pixels(method):
    layout, grid = layout_named("hexagons"), fs.Grid.centred((30, 20), (0.5, 0.2))
    picture = method(layout, np.full(layout.n_sites, 7.0), grid)
    covered_um2 = clipped_um2(layout, grid).sum(axis=0)

    np.testing.assert_allclose(picture.coverage, covered_um2 / grid.cell_area_um2, atol=1e-6)
    np.testing.assert_allclose(picture.data[0][picture.coverage > 0], 7.0, rtol=1e-6)


def test_least_squares_smoothness_ignores_pixel_shape():
    """The same smooth image is reconstructed on squares and on pixels of twice the height or width."""
    layout = fs.layout.grid(n_x=12, n_y=12, pitch_um=2.0)
    rng = np.random.default_rng(7)
    values = 100.0 + 5.0 * layout.centroid_um @ [0.5, 0.3] + rng.normal(0.0, 10.0, layout.n_sites)
    options = {"variance": 100.0, "response": np.ones(layout.n_sites), "mu": 0.05}
    x0, y0, *_ = layout.bounds_um
    square = least_squares(layout, values, fs.Grid((48, 48), 0.5, (x0, y0)), **options).data[0]
    high = least_squares(layout, values, fs.Grid((24, 48), (0.5, 1.0), (x0, y0)), **options).data[0]
    wide = least_squares(layout, values, fs.Grid((48, 24), (1.0, 0.5), (x0, y0)), **options).data[0]

    assert np.std(square) > 10.0
    assert np.abs(high - 0.5 * (square[::2] + square[1::2])).max() < 0.2
    assert np.abs(wide - 0.5 * (square[:, ::2] + square[:, 1::2])).max() < 0.2


def test_blur_kernel_sums_over_rectangular_pixels():
    """A kernel on pixels of three squares is the sum over squares, averaged over the position of the source square."""
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0)
    fine = blur_kernel(optics, fs.Grid((9, 9), 0.7), wavelength_nm=550.0, radius=20)
    wide = blur_kernel(optics, fs.Grid((9, 9), (2.1, 0.7)), wavelength_nm=550.0, radius=5)
    # From columns of pixels to columns of squares, weighted by the position of a square within the source pixel.
    expected = np.zeros((11, 11))
    for i, offset in enumerate(range(-5, 6)):
        for shift, weight in zip(range(-2, 3), (1 / 3, 2 / 3, 1.0, 2 / 3, 1 / 3), strict=True):
            expected[:, i] += weight * fine[15:26, 20 + 3 * offset + shift]

    np.testing.assert_allclose(wide, expected / expected.sum(), atol=1e-9)


def test_gradients_use_both_pitches():
    grid = fs.Grid.centred((40, 30), (0.3, 0.9))
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)
    layout = fs.layout.grid(n_x=3, n_y=5, pitch_um=1.5)

    gradient = site_gradients_e_per_um(layout, 90.0 + 2.0 * x_um - 0.5 * y_um, grid)

    np.testing.assert_allclose(gradient, layout.area_um2[:, np.newaxis] * [2.0, -0.5], rtol=1e-9)
    assert np.isfinite(flow_bound(gradient, 100.0).information_per_um2).all()


def test_voronoi_density_takes_rectangular_cells():
    coarse, fine = fs.Grid((10, 5), (4.0, 2.0)), fs.Grid((10, 10), 2.0)
    density = np.random.default_rng(9).uniform(0.5, 2.0, coarse.shape)
    options = {"n_sites": 40, "n_iterations": 10, "seed": 3}

    there = fs.layout.voronoi(density=density, density_grid=coarse, **options)
    here = fs.layout.voronoi(density=np.repeat(density, 2, axis=1), density_grid=fine, **options)

    np.testing.assert_allclose(there.bounds_um, (0.0, 0.0, 20.0, 20.0), atol=1e-9)
    np.testing.assert_allclose(there.centroid_um, here.centroid_um, atol=1e-6)


def test_optics_rejects_grid_of_rectangular_cells():
    scene = fs.Scene.flat(shape=(20, 20), pitch_um=100.0, distance_m=1.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0)

    with pytest.raises(ParameterError, match="'grid' must have square cells"):
        next(optics.weighted_maps(scene, np.ones((1, 1)), grid=fs.Grid((20, 20), (1.0, 2.0))))
