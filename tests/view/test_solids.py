"""Solid models of sensors: closed surfaces, volumes, overlaps, cuts and files."""

from __future__ import annotations

import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import FileError, GeometryError, LayoutWarning, ParameterError
from foveasim.view import SensorStack, render, solids, stack

PARTS = ("wells", "trenches", "filters", "lenses")
STACK = SensorStack(well_depth_um=3.0, trench_width_um=0.2, filter_thickness_um=0.6, lens_height_um=0.7)
NO_LENSES = SensorStack(lens_height_um=0.0)
FRAME = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(2, 2), (2, 6), (6, 6), (6, 2)]])
HOOK = shapely.Polygon([(20, 0), (28, 0), (28, 2), (22, 2), (22, 8), (20, 8)])
HORSESHOE = shapely.Polygon([(30, 0), (39, 0), (39, 9), (37, 9), (37, 2), (32, 2), (32, 9), (30, 9)])
LAYOUTS = {
    "squares": lambda: fs.layout.mosaic(fs.layout.grid(n_x=12, n_y=9, pitch_um=2.0), ("RG", "GB")),
    "hexagons": lambda: fs.layout.hexagonal(n_columns=10, n_rows=10, pitch_um=2.5),
    "rings with arcs": lambda: fs.layout.log_polar(n_sectors=24, min_size_um=2.0, r_max_um=54.7, stagger=True, chords_per_arc=3),
    "zones": lambda: fs.layout.node(fs.layout.zones(side_um=(8, 16, 32), pitch_um=(1, 2, 4))),
    "Voronoi, far from the origin": lambda: fs.layout.voronoi(n_sites=150, size_um=(30.0, 30.0), seed=3).translate(4000.0, -9000.0),
    "gaps": lambda: fs.layout.grid(n_x=5, n_y=5, pitch_um=3.0, trench_um=0.6),
}  # fmt: skip


def as_trimesh(mesh):
    import trimesh

    return trimesh.Trimesh(mesh.points_um, mesh.triangles, process=False)


def hull_um2(layout):
    return shapely.MultiPoint(layout.xy_um).convex_hull.area


# -- closed surfaces and volumes -----------------------------------------------------------------------------------------


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", LAYOUTS)
def test_parts_are_closed_without_overlap(name):
    model = solids(LAYOUTS[name](), STACK)
    report = model.check()

    assert tuple(model.parts) == PARTS
    assert report.ok
    assert [part.status for part in report.parts] == ["NoError"] * 4
    for mesh in model.meshes:
        body = as_trimesh(mesh)
        assert body.is_watertight
        assert body.is_winding_consistent
    # One sphere-like or ring-like piece per site.
    n = model.layout.n_sites
    assert [part.euler_characteristic for part in report.parts] == [2 * n, 0, 2 * n, 2 * n]
    assert max(report.overlap_um3.values()) <= 1e-9


@pytest.mark.parametrize("name", LAYOUTS)
def test_volumes_are_areas_times_thicknesses(name):
    layout = LAYOUTS[name]()
    model = solids(layout, STACK)
    well_um2 = fs.layout.inset(layout, 0.1).area_um2

    assert model.volumes_um3("wells") == pytest.approx(3.0 * well_um2, rel=1e-9)
    assert model.volumes_um3("trenches") == pytest.approx(3.0 * (layout.area_um2 - well_um2), rel=1e-9)
    assert model.volumes_um3("filters") == pytest.approx(0.6 * layout.area_um2, rel=1e-9)
    for part in model.check().parts:  # sums by manifold3d, also far from the origin
        assert part.volume_um3 == pytest.approx(model.volumes_um3(part.name).sum(), rel=1e-7)


def test_square_trench_volumes_match_hand_calculation():
    # 2 µm squares: wells of 1.8 µm side, trenches of 4 - 3.24 µm².
    model = solids(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0), STACK)

    assert model.volumes_um3("wells") == pytest.approx(np.full(9, 3.0 * 3.24), rel=1e-12)
    assert model.volumes_um3("trenches") == pytest.approx(np.full(9, 3.0 * 0.76), rel=1e-12)
    low, high = model.parts["wells"].bounds_um
    assert (low[2], high[2]) == (-3.0, 0.0)
    low, high = model.parts["lenses"].bounds_um
    assert (low[2], high[2]) == pytest.approx((0.6, 1.3))


@pytest.mark.parametrize("n_steps", [1, 4, 32])
def test_lens_volume_is_sum_of_frustums(n_steps):
    # A frustum between copies of an area A, scaled by s and t, has the volume A h (s² + s t + t²) / 3.
    layout = fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0)
    model = solids(layout, SensorStack(lens_height_um=0.5, n_lens_steps=n_steps))
    radius_um = np.sqrt(layout.area_um2[0] / np.pi)
    ball_um = (radius_um**2 + 0.25) / 1.0
    fraction = np.append(np.cos(0.5 * np.pi * np.arange(n_steps) / n_steps), 0.0)
    height_um = np.sqrt(ball_um**2 - (fraction * radius_um) ** 2) - (ball_um - 0.5)
    frustums = np.diff(height_um) * (fraction[1:] ** 2 + fraction[1:] * fraction[:-1] + fraction[:-1] ** 2) / 3.0

    assert model.volumes_um3("lenses") == pytest.approx(layout.area_um2 * frustums.sum(), rel=1e-9)


def test_disc_lens_approaches_spherical_cap():
    disc = fs.Layout.from_polygons([shapely.Point(5.0, 5.0).buffer(4.0, quad_segs=64)])
    model = solids(disc, SensorStack(lens_height_um=1.5, n_lens_steps=48))
    cap_um3 = np.pi * 1.5 * (3.0 * 16.0 + 1.5**2) / 6.0

    assert model.volumes_um3("lenses")[0] == pytest.approx(cap_um3, rel=2e-3)


def test_lens_is_at_most_a_hemisphere():
    model = solids(fs.Layout.from_rectangles([[0, 0], [20, 0]], [1.0, 9.0]), SensorStack(lens_height_um=3.0))
    mesh = model.parts["lenses"]
    top_um = [mesh.points_um[mesh.photosite == k, 2].max() for k in (0, 1)]

    assert top_um == pytest.approx([0.6 + 1.0 / np.sqrt(np.pi), 0.6 + 3.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["squares", "rings with arcs", "gaps"])
def test_round_lenses_closed_without_overlap(name):
    model = solids(LAYOUTS[name](), SensorStack(n_lens_corners=20, n_lens_steps=5))
    lenses = model.parts["lenses"]
    report = model.check()

    assert report.ok
    assert as_trimesh(lenses).is_watertight
    assert report.parts[3].euler_characteristic == 2 * model.layout.n_sites
    # No part of a lens overhangs another one: all faces except the floor face up.
    a, b, c = (lenses.points_um[lenses.triangles[:, k]] for k in range(3))
    upward = np.cross(b - a, c - a)[:, 2]
    assert np.all((upward > 0.0) | (np.maximum(np.maximum(a, b), c)[:, 2] <= 0.6))
    roof_um2 = 0.5 * np.bincount(lenses.photosite[lenses.triangles[:, 0]], weights=np.maximum(upward, 0.0))
    assert roof_um2 == pytest.approx(model.layout.area_um2, rel=1e-9)


def test_fill_factor_matches_layout():
    for make in LAYOUTS.values():
        layout = make()
        untrenched = solids(layout, SensorStack(trench_width_um=0.0))
        narrowed = solids(layout, STACK)

        assert tuple(untrenched.parts) == ("wells", "filters", "lenses")
        assert untrenched.fill_factor == pytest.approx(layout.describe().fill_factor, rel=1e-9)
        assert narrowed.fill_factor == pytest.approx(
            fs.layout.inset(layout, 0.1).area_um2.sum() / hull_um2(layout), rel=1e-9
        )


@pytest.mark.slow
def test_many_sites_closed_without_overlap():
    layout = fs.layout.grid(n_x=50, n_y=40, pitch_um=4.0)
    model = solids(layout, SensorStack(trench_width_um=0.4))
    report = model.check()

    assert report.ok
    assert all(as_trimesh(mesh).is_watertight for mesh in model.meshes)
    assert max(report.overlap_um3.values()) < 1e-9
    assert model.fill_factor == pytest.approx(0.81, rel=1e-9)
    assert report.parts[0].volume_um3 == pytest.approx(2000 * 3.6**2 * 3.0, rel=1e-9)
    assert report.parts[1].volume_um3 == pytest.approx(2000 * (16.0 - 3.6**2) * 3.0, rel=1e-9)
    assert report.parts[2].volume_um3 == pytest.approx(2000 * 16.0 * 0.6, rel=1e-9)


def test_check_detects_overlaps_and_open_surfaces():
    model = solids(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0), STACK)
    wells = model.parts["wells"]
    moved = type(wells)(**{**fields_of(wells), "points_um": wells.points_um + np.array([0.05, 0.0, 0.0])})
    opened = type(wells)(**{**fields_of(wells), "triangles": wells.triangles[1:]})

    shared = with_wells(model, moved).check()
    # Every well overlaps its own trench by 0.05 µm, over 1.8 µm by 3 µm.
    assert shared.overlap_um3["wells", "trenches"] == pytest.approx(9 * 0.05 * 1.8 * 3.0)
    assert not shared.ok
    not_closed = with_wells(model, opened).check()
    assert not_closed.parts[0].status == "NotManifold"
    assert not not_closed.ok


def fields_of(mesh):
    return {name: getattr(mesh, name) for name in ("name", "points_um", "triangles", "photosite", "values", "colours")}


def with_wells(model, wells):
    return type(model)(layout=model.layout, sensor_stack=model.sensor_stack, parts={**model.parts, "wells": wells})


# -- sites with holes and reflex vertices --------------------------------------------------------------------------------


def test_holes_and_reflex_vertices_are_preserved():
    # The well of the frame is also a frame; its trench follows the outline and the hole.
    layout = fs.Layout.from_polygons([FRAME, HOOK])
    model = solids(layout, NO_LENSES)
    report = model.check()
    well_um2 = [7.8**2 - 4.2**2, 60 - 4 * 7.0]

    assert report.ok
    assert all(as_trimesh(mesh).is_watertight for mesh in model.meshes)
    assert model.volumes_um3("wells")[0] == pytest.approx(3.0 * well_um2[0], rel=1e-9)
    assert model.volumes_um3("trenches") == pytest.approx(3.0 * layout.area_um2 - model.volumes_um3("wells"), rel=1e-9)
    assert {part.name: part.euler_characteristic for part in report.parts} == {
        "wells": 0 + 2,
        "trenches": 0 + 0 + 0,
        "filters": 0 + 2,
    }


def test_hole_touching_outline_gives_closed_solid():
    notched = shapely.Polygon([(30, 0), (38, 0), (38, 8), (30, 8)], [[(30, 0), (34, 6), (36, 4)]])
    model = solids(fs.Layout.from_polygons([notched]), SensorStack(trench_width_um=0.0, lens_height_um=0.0))

    assert model.check().ok
    assert model.volumes_um3("wells")[0] == pytest.approx(3.0 * notched.area, rel=1e-9)


def test_sites_without_lens_are_listed():
    box = shapely.box(-9, 0, -1, 8)
    with pytest.warns(
        LayoutWarning, match=r"site 0 and 1 more cannot have a lens: it has a hole, or is not star-shaped"
    ):
        model = solids(fs.Layout.from_polygons([FRAME, box, HORSESHOE]), STACK)
    alone = solids(fs.Layout.from_polygons([box]), STACK)

    assert model.sites_without_lens == (0, 2)
    assert np.unique(model.parts["lenses"].photosite).tolist() == [1]
    assert model.volumes_um3("lenses").tolist() == pytest.approx([0.0, alone.volumes_um3("lenses")[0], 0.0])
    assert model.check().ok
    with pytest.warns(LayoutWarning, match="site 0 cannot have a lens"):
        assert "lenses" not in solids(fs.Layout.from_polygons([HORSESHOE]), STACK).parts


def test_hole_on_edge_gives_closed_solid():
    # The hole touches the lower edge in its middle, where the outline has no vertex.
    site = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(4, 0), (6, 4), (2, 4)]])
    model = solids(fs.Layout.from_polygons([site]), SensorStack(trench_width_um=0.0, lens_height_um=0.0))

    assert model.check().ok
    assert model.volumes_um3("wells")[0] == pytest.approx(3.0 * site.area, rel=1e-9)


def test_open_solids_are_not_written(model, tmp_path):
    wells = model.parts["wells"]
    parts = {"wells": replace(wells, triangles=wells.triangles[1:])}

    with pytest.raises(GeometryError, match="the solids cannot be written, not closed: wells"):
        replace(model, parts=parts).write(tmp_path / "sensor.glb")
    assert not list(tmp_path.iterdir())


def test_hook_lens_uses_inscribed_circle():
    # The centroid lies outside; about the centre of the largest inscribed circle the site is star-shaped.
    hook = shapely.Polygon([(0, 0), (8, 0), (8, 3), (3, 3), (3, 8), (0, 8)])
    assert not hook.contains(hook.centroid)
    model = solids(fs.Layout.from_polygons([hook]), SensorStack())

    assert model.check().ok
    assert model.volumes_um3("lenses")[0] > 0.0


def test_trench_wider_than_site_raises():
    layout = fs.Layout.from_rectangles([[0, 0], [5, 0], [10, 0]], [[2, 2], [0.15, 2], [2, 2]])

    with pytest.raises(GeometryError, match=r"site 1 is too narrow for a trench of 0\.2 µm; use a smaller") as raised:
        solids(layout, STACK)
    assert raised.value.site_ids == (1,)


def test_solids_of_empty_layout_raise():
    with pytest.raises(GeometryError, match="no sites"):
        solids(fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0)[np.zeros(4, bool)])


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"well_depth_um": 0.0}, "'well_depth_um' must be > 0"),
        ({"trench_width_um": -0.1}, "'trench_width_um' must be >= 0"),
        ({"filter_thickness_um": 1e-7}, "'filter_thickness_um' must be 0, or from 0.0001 to 1000"),
        ({"lens_height_um": 5000.0}, "'lens_height_um' must be 0, or from 0.0001 to 1000"),
        ({"n_lens_steps": 0}, "'n_lens_steps' must be >= 1"),
        ({"n_lens_corners": -1}, "'n_lens_corners' must be >= 0"),
    ],
)
def test_invalid_thicknesses_raise_by_name(parameters, message):
    with pytest.raises(ParameterError, match=message):
        SensorStack(**parameters)


# -- cuts ----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("squares", "quarter"),
        ("squares", "two pieces"),
        ("rings with arcs", "slanted"),
        ("rings with arcs", "disc"),
        ("zones", "quarter"),
        ("zones", "disc"),
    ],
)
def test_cut_solids_closed_with_remaining_volume(name, shape):
    layout = LAYOUTS[name]()
    x0, y0, x1, y1 = layout.bounds_um
    x, y, size = 0.5 * (x0 + x1) + 0.123, 0.5 * (y0 + y1) - 0.217, max(x1 - x0, y1 - y0)
    region = {
        "quarter": shapely.box(x, y - size, x + size, y),
        "slanted": shapely.Polygon([(x, y), (x + size, y - 0.37 * size), (x + size, y + 2 * size)]),
        "disc": shapely.Point(x, y).buffer(0.2 * size),
        "two pieces": shapely.MultiPolygon(
            [shapely.box(x, y, x + 1.1, y + 1.3), shapely.box(x - size, y - size, x - 2.0, y - 0.7)]
        ),
    }[shape]
    cut = solids(layout, STACK).cut(region)
    left_um2 = shapely.area(shapely.difference(layout.polygons(), region))
    well_left_um2 = shapely.area(shapely.difference(fs.layout.inset(layout, 0.1).polygons(), region))

    assert cut.check().ok
    assert all(as_trimesh(mesh).is_watertight for mesh in cut.meshes)
    # Volumes per site require that every cut face has the correct photosite.
    assert cut.volumes_um3("filters") == pytest.approx(0.6 * left_um2, abs=1e-9 * layout.area_um2.max())
    assert cut.volumes_um3("wells") == pytest.approx(3.0 * well_left_um2, abs=1e-9 * layout.area_um2.max())


def test_cut_lens_volume_matches_manifold3d():
    import manifold3d

    model = solids(fs.layout.grid(n_x=2, n_y=2, pitch_um=4.0), STACK)
    region = shapely.box(-1.0, -5.0, 5.0, 1.2)
    lenses = model.parts["lenses"]
    body = manifold3d.Manifold(manifold3d.Mesh64(lenses.points_um, lenses.triangles.astype(np.uint64)))
    box = manifold3d.Manifold.cube((6.0, 6.2, 20.0)).translate((-1.0, -5.0, -10.0))

    assert model.cut(region).volumes_um3("lenses").sum() == pytest.approx((body - box).volume(), rel=1e-12)


def test_cut_pieces_keep_site_values():
    layout = LAYOUTS["squares"]()
    values = np.arange(layout.n_sites, dtype=float)
    cut = solids(layout, STACK, by=values).cut(shapely.box(-0.5, -50, 50, 0.4))

    for mesh in cut.meshes:
        assert np.array_equal(mesh.values, values[mesh.photosite])
        centre_um = np.stack([mesh.points_um[mesh.triangles[:, k]] for k in range(3)]).mean(axis=0)[:, :2]
        reach_um = np.abs(centre_um - layout.centroid_um[mesh.photosite[mesh.triangles[:, 0]]]).max()
        assert reach_um <= 1.0 + 1e-9


def test_partial_cut_leaves_other_parts():
    model = solids(LAYOUTS["hexagons"](), STACK)
    cut = model.cut(of=["lenses", "filters"])

    assert cut.parts["wells"] is model.parts["wells"]
    assert cut.volumes_um3("filters").sum() < model.volumes_um3("filters").sum()
    with pytest.raises(ParameterError, match="'part' must be one of 'wells', 'trenches'"):
        model.cut(of=["glass"])


def test_whole_cut_selects_sites_by_centroid():
    layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=2.0)  # centres at -3, -1, 1, 3
    cut = solids(layout, STACK).cut(shapely.box(0.9, -5, 9, 5), complete_sites=True)

    assert cut.volumes_um3("filters") == pytest.approx([2.4, 2.4, 0.0, 0.0])


def test_cut_of_everything_leaves_empty_solids(tmp_path):
    model = solids(fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0), STACK)
    nothing = model.cut(shapely.box(-9, -9, 9, 9))

    assert nothing.volumes_um3("wells").sum() == 0.0
    with pytest.raises(GeometryError, match="the scene is empty"):
        render(nothing, renderer="software")
    with pytest.raises(GeometryError, match="the solids have no triangles to write"):
        nothing.write(tmp_path / "none.glb")
    assert nothing.cut().fill_factor == 0.0


def test_stack_shows_every_layer():
    opened = stack(fs.layout.grid(n_x=20, n_y=20, pitch_um=2.0), STACK)
    volumes = [opened.volumes_um3(part) for part in PARTS]

    assert opened.check().ok
    # Higher layers have fewer complete sites.
    n_complete = [np.count_nonzero(v > 0.99 * v.max()) for v in volumes]
    assert n_complete[0] == n_complete[1] > n_complete[2] > n_complete[3] > 0


def test_capture_wells_show_code():
    layout = LAYOUTS["squares"]()
    sensor = fs.Sensor(layout, filters="rgb", capacitance_f=1e-15)
    scene = fs.Scene.flat(
        shape=(100, 100), pitch_um=20.0, distance_m=0.5, radiance_w_m2_sr_nm=1.0, wavelength_nm=(450, 540, 610)
    )
    taken = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor).capture(
        scene, exposure_s=0.01, seed=0
    )
    wells = solids(taken, STACK).parts["wells"]

    assert np.array_equal(wells.values, taken.code[wells.photosite])


# -- files ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def model():
    return solids(LAYOUTS["hexagons"](), STACK, by=np.arange(100.0))


def test_glb_file_preserves_faces_and_attributes(model, tmp_path):
    import trimesh

    model.write(tmp_path / "sensor.glb")
    loaded = trimesh.load(tmp_path / "sensor.glb", process=False)

    assert set(loaded.geometry) == set(PARTS)
    for name, mesh in model.parts.items():
        body = loaded.geometry[name]
        assert np.array_equal(body.faces, mesh.triangles)
        assert np.allclose(body.vertices, mesh.points_um, rtol=1e-6, atol=1e-5)  # glTF stores float32
        assert np.array_equal(np.ravel(body.vertex_attributes["_photosite"]), mesh.photosite)
        assert np.array_equal(np.ravel(body.vertex_attributes["_value"]), mesh.values)
        assert np.array_equal(body.visual.vertex_colors[:, :3], mesh.colours)
        assert body.is_watertight


@pytest.mark.parametrize("extension", [".ply", ".obj", ".3mf"])
def test_other_files_preserve_faces_and_volume(model, extension, tmp_path):
    import trimesh

    model.write(tmp_path / f"sensor{extension}")
    loaded = trimesh.load(tmp_path / f"sensor{extension}", process=False)
    bodies = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    n_faces = sum(len(body.faces) for body in bodies)
    volume_um3 = sum(model.volumes_um3(part).sum() for part in PARTS)

    assert n_faces == sum(mesh.triangles.shape[0] for mesh in model.meshes)
    assert sum(body.volume for body in bodies) == pytest.approx(volume_um3, rel=1e-5)
    if extension == ".3mf":  # opens at its true size, also in other programs
        assert {body.units for body in bodies} <= {"micron", "microns", "um"}
        with zipfile.ZipFile(tmp_path / "sensor.3mf") as archive:
            assert b'unit="micron"' in archive.read("3D/3dmodel.model")


@pytest.mark.parametrize("name", ["hexagons", "zones", "gaps"])
def test_stl_of_touching_bodies_is_watertight(name, tmp_path):
    import trimesh

    model = solids(LAYOUTS[name](), STACK)
    model.write(tmp_path / "sensor.stl")
    loaded = trimesh.load(tmp_path / "sensor.stl")  # merges equal points

    assert loaded.is_watertight
    assert loaded.volume == pytest.approx(sum(model.volumes_um3(part).sum() for part in PARTS), rel=1e-5)


def test_unknown_extension_raises_without_output(model, tmp_path):
    with pytest.raises(FileError, match=r"must end in \.glb, \.stl"):
        model.write(tmp_path / "sensor.step")
    with pytest.raises(FileError, match=r"the directory .* does not exist"):
        model.write(tmp_path / "none" / "sensor.glb")
    assert not list(tmp_path.iterdir())


def test_failed_export_keeps_existing_file(model, tmp_path, monkeypatch):
    import trimesh

    (tmp_path / "sensor.glb").write_bytes(b"before")

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(trimesh.Scene, "export", fail)
    with pytest.raises(FileError, match="cannot be written: No space left on device"):
        model.write(tmp_path / "sensor.glb")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"before"]


@pytest.mark.parametrize("library", ["lxml", "networkx"])
def test_missing_library_error_names_install_command(model, library, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)

    with pytest.raises(FileError, match=rf"needs {library}; install it with: pip install 'foveasim\[view\]'"):
        model.write(tmp_path / "a.3mf")
    assert not list(tmp_path.iterdir())


def test_solids_repr_lists_parts(model):
    assert (
        repr(model)
        == "Solids(2,000 triangles of wells, 4,800 triangles of trenches, 2,000 triangles of filters, 7,000 triangles of lenses)"
    )
    with pytest.raises(ParameterError, match="'part' must be one of"):
        model.volumes_um3("glass")
