"""Malformed layouts: integers beyond 64 bits, invalid holes, sensors of other layouts."""

from __future__ import annotations

import json

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import FileError, GeometryError, ParameterError

BEYOND = 2**64 - 1
SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10]]


def squares(n=2):
    return [shapely.box(3 * i, 0, 3 * i + 2, 2) for i in range(n)]


# -- integers --------------------------------------------------------------------------------------------------------

MAKERS = {
    "from_polygons": lambda **columns: fs.Layout.from_polygons(squares(), **columns),
    "from_rectangles": lambda **columns: fs.Layout.from_rectangles([[0, 0], [5, 0]], 1.0, **columns),
    "with_columns": lambda **columns: fs.layout.grid(n_x=2, n_y=1, pitch_um=1.0).with_columns(**columns),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize("name", ["channel", "readout_line"])
@pytest.mark.parametrize("value", [BEYOND, 2**63, 2**32, -1])
@pytest.mark.parametrize("as_array", [False, True])
def test_out_of_range_index_raises(make, name, value, as_array):
    values = np.array([0, value], np.uint64 if value > 0 else np.int64) if as_array else [0, value]

    with pytest.raises(ParameterError, match=f"'{name}' must contain integers from 0 to 50000000, got {value}"):
        make(**{name: values})


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_integer_columns_are_exact(make):
    layout = make(large=[0, BEYOND], negative=[-(2**63), 2**63 - 1])

    assert layout.columns["large"].tolist() == [0, BEYOND]
    assert layout.columns["negative"].tolist() == [-(2**63), 2**63 - 1]


@pytest.mark.parametrize("values", [[-1, BEYOND], [0, 2**64], [-(2**63) - 1, 0]])
def test_integers_beyond_64_bits_raise(values):
    with pytest.raises(
        ParameterError,
        match=r"'number' must contain integers from -2\*\*63 to 2\*\*63 - 1, or from 0 to 2\*\*64 - 1, got",
    ):
        fs.Layout.from_polygons(squares(), number=values)


def test_union_preserves_integers_exactly():
    small = fs.Layout.from_polygons(squares(), number=np.array([1, 2]))
    large = fs.Layout.from_polygons(squares(), number=np.array([1, BEYOND], np.uint64))
    negative = fs.Layout.from_polygons(squares(), number=np.array([-1, 2]))

    assert fs.layout.union([small, large]).columns["number"].tolist() == [1, 2, 1, BEYOND]
    assert fs.layout.union([negative, large[:1]]).columns["number"].tolist() == [-1, 2, 1]
    with pytest.raises(ParameterError, match=r"'number' must contain integers from -2\*\*63 to"):
        fs.layout.union([negative, large])


@pytest.mark.parametrize("name", ["channel", "readout_line"])
@pytest.mark.parametrize("value", [BEYOND, -1])
def test_geojson_and_npz_reject_invalid_indices(tmp_path, name, value):
    layout = fs.Layout.from_polygons(squares(), **{name: [0, 1]})
    layout.write(tmp_path / "a.geojson")
    text = (tmp_path / "a.geojson").read_text()
    assert f'"{name}": 1}}' in text
    (tmp_path / "a.geojson").write_text(text.replace(f'"{name}": 1}}', f'"{name}": {value}}}'))
    layout.write(tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as arrays:
        changed = dict(arrays) | {f"column_{name}": np.array([0, value], np.uint64 if value > 0 else np.int64)}
    np.savez(tmp_path / "b.npz", **changed)

    for file in ("a.geojson", "b.npz"):
        with pytest.raises(FileError, match=f"{file}: '{name}' must contain integers from 0 to 50000000, got {value}"):
            fs.read_layout(tmp_path / file)


def test_gdsii_and_parquet_reject_invalid_indices(tmp_path):
    gdstk, pq = pytest.importorskip("gdstk"), pytest.importorskip("pyarrow.parquet")
    import pyarrow as pa

    layout = fs.Layout.from_polygons(squares(), readout_line=[0, 1])
    layout.write(tmp_path / "a.gds")
    library = gdstk.read_gds(tmp_path / "a.gds")
    for k, polygon in enumerate(library.cells[0].polygons):
        polygon.delete_gds_property(2)
        polygon.set_gds_property(2, f"readout_line={BEYOND if k else 0}")
    library.write_gds(tmp_path / "a.gds")
    layout.write(tmp_path / "b.parquet")
    table = pq.read_table(tmp_path / "b.parquet")
    at = table.schema.get_field_index("readout_line")
    table = table.set_column(at, "readout_line", pa.array([0, BEYOND], pa.uint64()))
    pq.write_table(table, tmp_path / "b.parquet")

    for file in ("a.gds", "b.parquet"):
        with pytest.raises(
            FileError, match=f"{file}: 'readout_line' must contain integers from 0 to 50000000, got {BEYOND}"
        ):
            fs.read_layout(tmp_path / file)


def test_geojson_preserves_integers_among_floats(tmp_path):
    layout = fs.Layout.from_polygons(squares())
    layout.write(tmp_path / "a.geojson")
    document = json.loads((tmp_path / "a.geojson").read_text())
    for feature, (number, value) in zip(document["features"], [(2**53 + 1, 1), (None, 0.5)], strict=True):
        feature["properties"] = {"number": number, "value": value}
    (tmp_path / "a.geojson").write_text(json.dumps(document))
    read = fs.read_layout(tmp_path / "a.geojson")

    # Converted to float, with NaN for null, the integer would change.
    assert "number" not in read.columns
    assert read.provenance["left_out_properties"] == ["number"]
    assert read.columns["value"].tolist() == [1.0, 0.5]


# -- holes -----------------------------------------------------------------------------------------------------------


def with_holes(*holes, clockwise=True):
    """Packed rings of three sites; site 1 is a square of 10 µm with the holes."""
    near = [[-5, 0], [-4, 0], [-4, 1], [-5, 1]]
    far = [[40, 0], [41, 0], [41, 1], [40, 1]]
    rings = [near, SQUARE, *(hole[::-1] if clockwise else hole for hole in holes), far]
    xy_um = np.array([vertex for ring in rings for vertex in ring], float)
    return xy_um, np.cumsum([0, *map(len, rings)]), np.array([0, 1, 2 + len(holes), 3 + len(holes)])


def box(x0, y0, x1, y1):
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


BAD_HOLES = {
    "outside": ([box(20, 2, 22, 4)], "has a hole outside its outline"),
    "partly outside": ([box(8, 2, 12, 4)], "crosses or touches itself"),
    "around the outline": ([box(-1, -1, 11, 11)], "has a hole outside its outline"),
    "the outline itself": ([box(0, 0, 10, 10)], "crosses or touches itself"),
    "overlapping": ([box(2, 2, 5, 5), box(4, 4, 7, 7)], "crosses or touches itself"),
    "nested": ([box(2, 2, 8, 8), box(4, 4, 6, 6)], "has a hole inside another hole"),
    "duplicate": ([box(2, 2, 8, 8), box(2, 2, 8, 8)], "crosses or touches itself"),
}


@pytest.mark.parametrize(("holes", "message"), BAD_HOLES.values(), ids=BAD_HOLES)
def test_misplaced_hole_raises(holes, message, tmp_path):
    xy_um, ring_offsets, site_offsets = with_holes(*holes)
    for make in (fs.Layout, lambda *rings: fs.Layout.from_polygons(rings)):
        with pytest.raises(GeometryError, match=f"site 1 {message}") as caught:
            make(xy_um, ring_offsets, site_offsets)
        assert caught.value.site_ids == (1,)

    valid = fs.Layout(*with_holes(box(2, 2, 3, 3)))
    valid.write(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        rings = {"xy_um": xy_um, "ring_offsets": ring_offsets, "site_offsets": site_offsets}
        np.savez(tmp_path / "a.npz", **(dict(arrays) | rings))
    with pytest.raises(FileError, match=f"a.npz: site 1 {message}"):
        fs.read_layout(tmp_path / "a.npz")


def test_counter_clockwise_hole_raises():
    with pytest.raises(GeometryError, match="site 1 has a hole that is wound the wrong way, or has no area"):
        fs.Layout(*with_holes(box(2, 2, 3, 3), clockwise=False))


def test_valid_holes_may_touch_in_points():
    diamond = [[5, 5], [6, 6], [5, 7], [4, 6]]
    at_boundary = [[0, 5], [2, 4], [2, 6]]  # touches the outline in one point
    layout = fs.Layout(*with_holes(box(2, 2, 4, 4), diamond, at_boundary))

    assert layout.area_um2.tolist() == pytest.approx([1.0, 100.0 - 4.0 - 2.0 - 2.0, 1.0])


@pytest.mark.parametrize("angle_deg", [1.0, 33.3, 71.2])
def test_transformations_preserve_touching_holes(angle_deg):
    at_boundary = [[0, 5], [2, 4], [2, 6]]
    layout = fs.Layout(*with_holes(at_boundary, box(5, 5, 6, 6)))
    moved = layout.rotate(angle_deg).translate(1e3 / 3.0, -7.7).scale(0.1)

    # Rounding may move the common point to either side of the outline.
    assert moved.area_um2.sum() == pytest.approx(0.01 * layout.area_um2.sum())
    assert moved[1:].n_sites == 2
    assert moved.with_columns(channel=[0, 1, 2]).n_sites == 3


def test_error_lists_all_invalid_sites():
    n = 8
    shells = [box(20 * i, 0, 20 * i + 10, 10) for i in range(n)]
    holes = [box(20 * i + (12 if i % 2 else 2), 2, 20 * i + (14 if i % 2 else 4), 4)[::-1] for i in range(n)]
    rings = [ring for pair in zip(shells, holes, strict=True) for ring in pair]

    with pytest.raises(GeometryError, match=r"site 1 has a hole outside .* \(and 3 more: 3, 5, 7\)") as caught:
        fs.Layout(np.array(rings, float).reshape(-1, 2), 4 * np.arange(2 * n + 1), 2 * np.arange(n + 1))
    assert caught.value.site_ids == (1, 3, 5, 7)


# -- sensors ---------------------------------------------------------------------------------------------------------


def capture_of(layout):
    scene = fs.Scene.flat(
        shape=(400, 400),
        pitch_um=100.0,
        distance_m=1.0,
        radiance_w_m2_sr_nm=0.1,
        wavelength_nm=[550.0],
        band_width_nm=10.0,
    )
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=fs.Sensor(layout))
    return camera.capture(scene, exposure_s=0.001, seed=0)


@pytest.mark.parametrize("options", [{}, {"of": "light_e"}, {"per": "um2"}, {"method": "least_squares"}])
def test_picture_rejects_sensor_of_other_layout(options):
    layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    capture = capture_of(layout)
    others = [layout.translate(0.5, 0.0), fs.layout.grid(n_x=2, n_y=8, pitch_um=2.0), layout[::-1], layout[:8]]

    for other in others:
        with pytest.raises(ParameterError, match="'sensor' must be the Sensor of the capture's layout"):
            capture.picture(max_pixels=8, sensor=fs.Sensor(other), **options)


@pytest.mark.parametrize(("estimate", "name"), [("estimate_from_charge", "charge_e"), ("estimate_from_code", "code")])
def test_estimates_reject_wrong_number_of_values(estimate, name):
    sensor = fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0))

    with pytest.raises(ParameterError, match=f"'{name}' must have one value for each of the 4 sites, got the shape"):
        getattr(fs.reconstruct, estimate)(np.ones(3), sensor, 0.1)


def test_picture_accepts_sensor_of_equal_layout(tmp_path):
    layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    capture = capture_of(layout)
    capture.save(tmp_path / "capture.npz")
    loaded = fs.Capture.load(tmp_path / "capture.npz")
    sensor = fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0).with_columns(note=np.arange(16)))
    expected = capture.picture(max_pixels=8, of="light_e", sensor=fs.Sensor(layout)).data

    for each in (capture, loaded):
        assert np.array_equal(each.picture(max_pixels=8, of="light_e", sensor=sensor).data, expected)
