"""Three-dimensional views: PyVista data, prisms with the heights of values, and agreement of both renderers."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import shapely
import shapely.affinity

import foveasim as fs
from foveasim._io.images import read_picture
from foveasim.errors import FileError, FoveasimWarning, GeometryError, ParameterError, SimulationError
from foveasim.view import (
    Mesh,
    SensorStack,
    Viewpoint,
    picture_colours,
    plotter,
    prisms,
    render,
    render3d,
    renderer,
    show,
    sites_in_view,
    solids,
    stack,
)
from foveasim.view._annotations import strip_width_px
from foveasim.view.meshes import triangulate
from foveasim.view.site_colours import FILTER_COLOURS

FRAME = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(2, 2), (2, 6), (6, 6), (6, 2)]])
HOOK = shapely.Polygon([(20, 0), (28, 0), (28, 2), (22, 2), (22, 8), (20, 8)])
#: The hole touches the outline in a corner.
NOTCHED = shapely.Polygon([(30, 0), (38, 0), (38, 8), (30, 8)], [[(30, 0), (34, 6), (36, 4)]])
#: Edges have collinear vertices, so that every fan from a corner has degenerate triangles.
NODED = shapely.Polygon(
    [(40 + x, y) for x, y in [(0, 0), (3, 0), (6, 0), (9, 0), (9, 3), (9, 6), (9, 9), (5, 9), (0, 9), (0, 5)]]
)
ODD = [FRAME, shapely.box(10, 0, 12, 8), HOOK, NOTCHED, NODED]
ODD_LAYOUT = fs.Layout.from_polygons(ODD, channel=[0, 1, 2, 0, 1], name=["a", "b", "c", "d", "e"])
STRAIGHT_DOWN = Viewpoint(azimuth_deg=-90.0, elevation_deg=90.0)


def area_um2(layout, caps):
    a, b, c = (layout.xy_um[caps.triangles[:, k]] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return 0.5 * (ux * vy - uy * vx)


def capture():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=5, pitch_um=2.0), ("RG", "GB"))
    sensor = fs.Sensor(layout, filters="rgb", capacitance_f=1e-15)
    scene = fs.Scene.flat(
        shape=(100, 100), pitch_um=20.0, distance_m=0.5, radiance_w_m2_sr_nm=1.0, wavelength_nm=(450, 540, 610)
    )
    return fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor).capture(
        scene, exposure_s=0.01, seed=0
    )


# -- triangles -----------------------------------------------------------------------------------------------------------


LAYOUTS = {
    "odd": lambda: ODD_LAYOUT,
    "hexagons": lambda: fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=2.0),
    "rings with arcs": lambda: fs.layout.log_polar(n_sectors=48, min_size_um=2.0, r_max_um=54.0, stagger=True, chords_per_arc=4),
    "T-junctions noded": lambda: fs.layout.node(fs.layout.zones(side_um=(8, 16, 32), pitch_um=(1, 2, 4))),
    "Penrose": lambda: fs.layout.penrose(side_um=2.0, size_um=30.0),
    "Voronoi": lambda: fs.layout.voronoi(n_sites=200, size_um=(30.0, 30.0), seed=3),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_triangles_cover_every_site_once(name):
    layout = LAYOUTS[name]()
    caps = triangulate(layout)
    areas_um2 = area_um2(layout, caps)

    assert np.all(areas_um2 > 0.0)
    assert np.bincount(caps.site, weights=areas_um2) == pytest.approx(layout.area_um2, rel=1e-12)
    # Triangles use all vertices of their own site: n - 2 for an outline, 2 more for a hole that does not touch it.
    n_vertices = np.diff(layout.ring_offsets[layout.site_offsets])
    n_holes = np.where(np.arange(layout.n_sites) == 3, 0, np.diff(layout.site_offsets) - 1)
    assert np.array_equal(np.bincount(caps.site), n_vertices - 2 + 2 * n_holes)
    site_of_vertex = np.repeat(np.arange(layout.n_sites), n_vertices)
    assert np.array_equal(site_of_vertex[caps.triangles], np.repeat(caps.site[:, np.newaxis], 3, axis=1))


def test_triangles_lie_inside_their_site():
    caps = triangulate(ODD_LAYOUT)
    triangles = shapely.polygons(ODD_LAYOUT.xy_um[caps.triangles])
    outside = shapely.difference(triangles, np.array(ODD)[caps.site])

    assert shapely.area(outside).max() < 1e-12


# -- PyVista data --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_polydata_cells_have_all_columns():
    layout = fs.layout.hexagonal(n_columns=4, n_rows=3, pitch_um=2.0).with_columns(zone=np.arange(12) // 5)
    mesh = layout.to_pyvista()

    assert mesh.n_cells == 12
    assert np.array_equal(mesh.cell_data["site"], np.arange(12))
    assert mesh.active_scalars_name == "area_um2"
    assert np.array_equal(mesh.cell_data["zone"], np.arange(12) // 5)
    assert mesh.cell_data["area_um2"] == pytest.approx(layout.area_um2)
    assert mesh.compute_cell_sizes()["Area"] == pytest.approx(layout.area_um2)
    assert {"channel", "readout_line", *layout.columns} <= set(mesh.cell_data.keys())
    assert json.loads(mesh.field_data["provenance"][0])["generator"] == "hexagonal"


def test_concave_sites_are_single_cells():
    # The hook, an arrow of four vertices, and a site with collinear vertices; and two with holes, which are triangles.
    arrow = shapely.Polygon([(60, 0), (68, 4), (60, 8), (63, 4)])
    layout = fs.Layout.from_polygons([*ODD, arrow], name=list("abcdef"))
    mesh = layout.to_pyvista()
    site = np.asarray(mesh.cell_data["site"])
    parts = mesh.triangulate()
    sizes = np.asarray(parts.compute_cell_sizes()["Area"])

    assert np.bincount(np.asarray(parts.cell_data["site"]), weights=sizes) == pytest.approx(layout.area_um2)
    assert np.array_equal(site, np.sort(site))
    assert [np.count_nonzero(site == k) for k in (1, 2, 4, 5)] == [1, 1, 1, 1]
    assert [str(name) for name in mesh.cell_data["name"]] == [list("abcdef")[k] for k in site]
    assert layout[[1, 2, 4, 5]].to_pyvista().n_cells == 4


@pytest.mark.slow
@pytest.mark.needs("renderer")
def test_pyvista_fills_concave_cells_exactly():
    renderer.begin_rendering()
    import pyvista

    arrows = [[(0, 0), (8, 4), (0, 8), (3, 4)], [(8, 4), (0, 8), (3, 4), (0, 0)], [(0, 8), (3, 4), (0, 0), (8, 4)]]
    shapes = [shapely.affinity.translate(shapely.Polygon(ring), 10 * k) for k, ring in enumerate(arrows)]
    mesh = fs.Layout.from_polygons([*shapes, shapely.affinity.translate(HOOK, 12)]).to_pyvista()
    assert mesh.n_cells == 4
    plot = pyvista.Plotter(off_screen=True, window_size=(420, 100), lighting=None)
    plot.render_window.SetMultiSamples(0)
    plot.set_background("white")
    plot.add_mesh(mesh, color="black", lighting=False)
    plot.camera.parallel_projection = True
    plot.camera.position, plot.camera.focal_point, plot.camera.up = (20.5, 4, 50), (20.5, 4, 0), (0, 1, 0)
    plot.camera.parallel_scale = 5.0
    drawn = np.asarray(plot.screenshot(None, return_img=True))[..., 0] < 128
    plot.close()
    x_um, y_um = np.meshgrid(20.5 + (np.arange(420) - 209.5) / 10.0, 4.0 - (np.arange(100) - 49.5) / 10.0)
    inside = np.any(
        [shapely.contains_xy(s, x_um, y_um) for s in [*shapes, shapely.affinity.translate(HOOK, 12)]], axis=0
    )

    assert np.mean(drawn != inside) < 0.01


def test_polydata_contains_capture_values_and_settings():
    taken = capture()
    mesh = taken.to_pyvista()

    for name in ("code", "electrons", "expected_e", "filter_of_site"):
        assert np.array_equal(mesh.cell_data[name], getattr(taken, name))
    assert mesh.active_scalars_name == "code"
    assert json.loads(mesh.field_data["units"][0]) == {
        "code": "DN", "code_dn": "DN", "electrons": "e-", "expected_e": "e-", "area_um2": "µm²"
    }  # fmt: skip
    assert json.loads(mesh.field_data["settings"][0]) == json.loads(json.dumps(taken.settings))


def test_empty_layout_gives_empty_mesh():
    assert ODD_LAYOUT[np.zeros(5, bool)].to_pyvista().n_cells == 0


def test_missing_pyvista_error_names_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)

    with pytest.raises(ParameterError, match=r"needs pyvista; install it with: pip install 'foveasim\[view\]'"):
        ODD_LAYOUT.to_pyvista()


# -- prisms --------------------------------------------------------------------------------------------------------------


def test_prism_heights_proportional_to_values():
    values = np.array([1.0, 4.0, 2.0, 0.0, 3.0])
    columns = prisms(ODD_LAYOUT, values, max_height_um=8.0)
    top_um = np.zeros(5)
    np.maximum.at(top_um, columns.photosite, columns.points_um[:, 2])

    assert top_um == pytest.approx(2.0 * values)
    assert np.array_equal(columns.values, values[columns.photosite])


def test_prism_surface_is_tops_and_walls():
    # Area of the sites, and length of their outlines times the height.
    columns = prisms(ODD_LAYOUT, np.ones(5), max_height_um=3.0)
    a, b, c = (columns.points_um[columns.triangles[:, k]] for k in range(3))
    surface_um2 = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()

    assert surface_um2 == pytest.approx(ODD_LAYOUT.area_um2.sum() + 3.0 * shapely.length(np.array(ODD)).sum())


def test_capture_prisms_show_code_and_filters():
    taken = capture()
    columns = prisms(taken, "code")

    assert np.array_equal(columns.values, taken.code[columns.photosite])
    is_red = taken.filter_of_site[columns.photosite] == taken.filter_names.index("R")
    assert np.all(columns.colours[is_red].argmax(axis=1) == 0)


def test_prism_height_and_colour_columns():
    layout = ODD_LAYOUT.with_columns(depth_um=np.arange(5.0))
    columns = prisms(layout, "depth_um", by="channel")

    assert np.array_equal(np.unique(columns.values), np.arange(5.0))
    assert len(np.unique(columns.colours, axis=0)) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height": np.ones(4)}, "'height' must have one row for each of the 5 sites"),
        ({"height": -np.ones(5)}, "'height' must be >= 0"),
        ({"height": np.array([1, 2, 3, 4, np.nan])}, "'height' must be finite"),
        ({"height": "name"}, "'height' must be an array of numbers"),
        ({"height": "no such column"}, "'height' must be the name of a column"),
        ({"height": np.ones((5, 3))}, "'height' must have 1 dimension"),
        ({"max_height_um": 0.0}, "'max_height_um' must be > 0"),
    ],
)
def test_invalid_heights_raise_by_name(arguments, message):
    with pytest.raises(ParameterError, match=message):
        prisms(ODD_LAYOUT, **arguments)


def test_prisms_of_empty_layout_raise():
    with pytest.raises(GeometryError, match="no sites"):
        prisms(ODD_LAYOUT[np.zeros(5, bool)])


# -- software renderer ---------------------------------------------------------------------------------------------------


def software(scene, **parameters):
    return render(scene, renderer="software", **{"size_px": (300, 200), "oversampling": 1, **parameters})


def test_top_view_shows_site_under_pixel():
    # Prisms of equal height show the layout, enlarged.
    flat = prisms(ODD_LAYOUT, np.ones(5), max_height_um=0.01)
    site = sites_in_view(flat, viewpoint=STRAIGHT_DOWN, size_px=(980, 200))
    visible = np.argwhere(site >= 0)
    left, right, top, bottom = (
        visible[:, 1].min(),
        visible[:, 1].max() + 1,
        visible[:, 0].min(),
        visible[:, 0].max() + 1,
    )
    x0, y0, x1, y1 = ODD_LAYOUT.bounds_um
    x_um = x0 + (np.arange(left, right) + 0.5 - left) / (right - left) * (x1 - x0)
    y_um = y1 - (np.arange(top, bottom) + 0.5 - top) / (bottom - top) * (y1 - y0)  # top row first: y up
    expected = np.full((bottom - top, right - left), -1)
    for k, polygon in enumerate(ODD):
        expected[shapely.contains_xy(polygon, *np.meshgrid(x_um, y_um))] = k

    assert np.mean(site[top:bottom, left:right] == expected) > 0.98


def test_nearer_prism_hides_farther_in_any_order():
    for y_um in ([0.0, 20.0], [20.0, 0.0]):
        layout = fs.Layout.from_rectangles([[0.0, y_um[0]], [0.0, y_um[1]]], 4.0)
        site = sites_in_view(
            prisms(layout, [1.0, 1.0], max_height_um=30.0), viewpoint=Viewpoint(azimuth_deg=-90, elevation_deg=0)
        )
        near = int(np.argmin(y_um))  # the viewer is at small y

        assert set(np.unique(site)) == {-1, near}


def test_projected_size_follows_perspective():
    corners = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    squares = Mesh(
        name="squares",
        points_um=np.concatenate(
            [np.column_stack((corners + np.array([x, 0.0]), np.full(4, z))) for x, z in ((-20.0, 0.0), (20.0, 40.0))]
        ),
        triangles=np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32),
        photosite=np.repeat(np.array([0, 1], np.int32), 4),
        values=np.zeros(8),
        colours=np.zeros((8, 3), np.uint8),
    )
    viewpoint = Viewpoint(azimuth_deg=-90.0, elevation_deg=90.0, focus_um=(0.0, 0.0, 0.0), view_deg=60.0)
    above_um = render3d._eye([squares], viewpoint, (1600, 1000)).position_um[2]
    n_seen = np.bincount(sites_in_view(squares, viewpoint=viewpoint).ravel() + 1)[1:]

    assert np.sqrt(n_seen[1] / n_seen[0]) == pytest.approx(above_um / (above_um - 40.0), rel=0.02)
    assert above_um / (above_um - 40.0) > 1.5


def test_shading_of_tops_and_walls():
    layout = fs.Layout.from_rectangles([[0.0, 0.0]], 10.0)
    mesh = prisms(layout, [1.0], max_height_um=10.0, by=np.array([[200, 100, 40]], np.uint8))
    light = np.array(render3d.LIGHT_DIRECTION) / np.linalg.norm(render3d.LIGHT_DIRECTION)
    picture = software(mesh, viewpoint=Viewpoint(azimuth_deg=-90.0, elevation_deg=40.0))
    roof = np.array([200, 100, 40]) * (render3d.AMBIENT + render3d.DIFFUSE * light[2])
    front = np.array([200, 100, 40]) * (render3d.AMBIENT + render3d.DIFFUSE * light[1])

    assert set(map(tuple, picture.reshape(-1, 3).tolist())) == {
        render3d.BACKGROUND, tuple(np.rint(roof).astype(int)), tuple(np.rint(front).astype(int))
    }  # fmt: skip


def test_shading_clips_no_colour():
    picture = software(prisms(ODD_LAYOUT, np.ones(5), by=np.full((5, 3), 255, np.uint8)))
    visible = picture[np.any(picture != render3d.BACKGROUND, axis=-1)]

    assert pytest.approx(1.0) == render3d.AMBIENT + render3d.DIFFUSE
    assert visible.max() < 255
    assert len(np.unique(visible[:, 0])) >= 3


def test_oversampling_averages_finer_pixels():
    columns = prisms(ODD_LAYOUT, np.arange(5.0))
    fine = software(columns, size_px=(600, 400)).astype(float)
    mean = fine.reshape(200, 2, 300, 2, 3).mean(axis=(1, 3))

    assert np.abs(software(columns, oversampling=2) - mean).max() <= 0.5


@pytest.mark.parametrize("n_threads", [1, 3, 7])
def test_rendering_independent_of_threads(n_threads, monkeypatch):
    columns = prisms(ODD_LAYOUT, np.arange(5.0))
    expected = software(columns)
    monkeypatch.setattr(render3d, "thread_count", lambda: n_threads)

    assert np.array_equal(software(columns), expected)


def test_zoom_two_doubles_lengths():
    columns = prisms(fs.layout.grid(n_x=9, n_y=9, pitch_um=2.0), np.ones(81), max_height_um=0.01)
    plain, near = (
        sites_in_view(columns, viewpoint=Viewpoint(azimuth_deg=-90, elevation_deg=90, zoom=zoom)) for zoom in (1.0, 2.0)
    )

    assert np.count_nonzero(near == 40) == pytest.approx(4 * np.count_nonzero(plain == 40), rel=0.02)


@pytest.mark.parametrize(
    "viewpoint", [Viewpoint(azimuth_deg=a, elevation_deg=e) for a in (-120, 10, 200) for e in (-30, 5, 60, 90)]
)
def test_scene_fits_and_fills_picture(viewpoint):
    columns, size_px = prisms(ODD_LAYOUT, np.arange(5.0)), np.array([400, 300])
    screen = render3d._eye([columns], viewpoint, (400, 300)).project(columns.points_um, (400, 300))
    margins = np.array([screen[:, :2].min(axis=0), size_px - screen[:, :2].max(axis=0)]) / size_px

    assert np.all(screen[:, 2] > 0.0)
    assert margins.min(axis=0).min() == pytest.approx(0.5 * (1.0 - render3d.FILLED_FRACTION), abs=0.002)
    assert margins[0] == pytest.approx(margins[1], abs=0.002)
    picture = software(columns, viewpoint=viewpoint)
    assert np.all(picture[[0, -1]] == render3d.BACKGROUND)
    assert np.all(picture[:, [0, -1]] == render3d.BACKGROUND)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"oversampling": 0}, "'oversampling' must be >= 1"),
        ({"size_px": (0, 5)}, r"'size_px\[0\]' must be >= 1"),
        ({"size_px": (100_000, 5)}, "'size_px' must be <= "),
        ({"background": (1, 2)}, "'background' must be three"),
        ({"background": (1, 2, 300)}, "'background' must be three"),
        ({"renderer": "best"}, "'renderer' must be one of"),
    ],
)
def test_invalid_render_parameters_raise(parameters, message):
    with pytest.raises(ParameterError, match=message):
        render(prisms(ODD_LAYOUT), **{"renderer": "software", **parameters})


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"elevation_deg": 91.0}, "'elevation_deg' must be <= 90"),
        ({"zoom": 0.0}, "'zoom' must be > 0"),
        ({"view_deg": 180.0}, "'view_deg' must be <= 120"),
        ({"focus_um": (1.0, 2.0)}, "'focus_um' must be three numbers"),
    ],
)
def test_invalid_viewpoints_raise_by_name(parameters, message):
    with pytest.raises(ParameterError, match=message):
        Viewpoint(**parameters)


def test_invalid_scene_raises():
    with pytest.raises(ParameterError, match="'scene' must be a Mesh"):
        render(3)
    with pytest.raises(ParameterError, match=r"'scene(.0.)?' must be"):
        render([ODD_LAYOUT])
    with pytest.raises(GeometryError, match="the scene is empty"):
        render([])


def test_capture_renders_with_titled_colour_bar():
    taken = prisms(capture(), "code")
    picture = software(taken, size_px=(300, 200), legend=True)
    bare = software(taken, size_px=(300, 200), legend=False)
    width = sum(strip_width_px(taken.shown, [], 200))
    assert picture.shape == bare.shape == (200, 300, 3)
    assert np.array_equal(picture[:, :-width], software(taken, size_px=(300 - width, 200), legend=False))

    # The bar is grey from black to white; text is dark.
    strip = picture[:, -width:].astype(int)
    column = strip[
        :, np.argmax(np.ptp(strip[..., 0], axis=0) + np.count_nonzero(np.diff(strip[..., 0], axis=0), axis=0))
    ]
    assert len(np.unique(column[:, 0])) > 60
    assert taken.title == "code / DN"
    assert np.array_equal(
        software(capture(), size_px=(300, 200), legend=False), software(prisms(capture()), size_px=(300, 200))
    )


def test_columns_of_colour_capture_have_picture_colours():
    picture = np.zeros((8, 12, 3), np.uint8)
    picture[:, :6], picture[:, 6:] = (200, 60, 40), (40, 90, 200)
    layout = fs.layout.mosaic(fs.layout.grid(n_x=24, n_y=16, pitch_um=5.0), "RGGB")
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout, filters="rgb", bits=12)
    )
    scene = fs.Scene.from_picture(picture, fit="cover", distance_m=1.0, illuminance_lux=500.0)
    taken = camera.capture(scene, exposure_s="auto", seed=0)
    columns = prisms(taken)
    x_um = layout.centroid_um[columns.photosite, 0]

    left, right = (np.median(columns.colours[where], axis=0) for where in (x_um < -10.0, x_um > 10.0))
    assert left[0] > 2 * left[2]
    assert right[2] > 2 * right[0]
    assert columns.title == "code / DN"
    assert prisms(taken, "code").shown.values is not None


def test_filter_legend_has_every_colour():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0), ("RG", "GB"))
    picture = software(prisms(layout, by="channel"), size_px=(400, 200), legend=True)
    strip = picture[:, -70:].reshape(-1, 3)

    assert all(np.any(np.all(strip == colour, axis=1)) for colour in (FILTER_COLOURS[name] for name in "RGB"))
    with pytest.raises(ParameterError, match="'size_px' must leave space for the scene"):
        software(prisms(layout, by="channel"), size_px=(60, 200), legend=True)


def test_labels_end_on_their_parts():
    stack_of = SensorStack(well_depth_um=3.0, trench_width_um=0.3, lens_height_um=0.8)
    model = stack(fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), stack_of)
    meshes, size_px = list(model.meshes), (500, 400)
    eye = render3d._eye(meshes, Viewpoint(), size_px)
    ids, _ = render3d._nearest(meshes, eye, size_px)
    ends = np.cumsum([mesh.triangles.shape[0] for mesh in meshes])
    labels = render3d._labels(meshes, [mesh.name for mesh in meshes], eye, size_px, 1)

    assert [label.text for label in labels] == ["wells", "trenches", "filters", "lenses"]
    for label in labels:
        part = np.searchsorted(ends, ids[int(label.y_px), int(label.x_px)], side="right")
        assert meshes[part].name == label.text
    assert software(model, size_px=(700, 400), labels=True).shape == (400, 700, 3)


def test_smooth_lens_normals_follow_sphere():
    # A dense dome over a regular 48-gon: the normal of a sphere points away from its centre.
    disc = fs.Layout.from_polygons([shapely.Point(0, 0).buffer(2.0, quad_segs=12)])
    model = solids(disc, SensorStack(lens_height_um=0.8, n_lens_steps=24, trench_width_um=0.0, filter_thickness_um=0.0))
    dome = model.parts["lenses"]
    radius_um = np.sqrt(disc.area_um2[0] / np.pi)
    ball_um = (radius_um**2 + 0.8**2) / 1.6
    is_inner = (np.hypot(*dome.points_um[:, :2].T) < 1.7) & (dome.points_um[:, 2] > 0.0)
    expected = dome.points_um[is_inner] - (0.0, 0.0, 0.8 - ball_um)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)

    assert dome.is_smooth
    assert np.sum(is_inner) > 200
    assert np.einsum("ij,ij->i", render3d.point_normals(dome)[is_inner], expected).min() > np.cos(np.radians(2.0))


def test_solids_become_named_blocks():
    model = solids(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0))
    blocks = model.to_pyvista()

    assert list(blocks.keys()) == ["wells", "trenches", "filters", "lenses"]
    assert blocks["wells"].n_cells == model.parts["wells"].triangles.shape[0]
    assert set(np.unique(blocks["lenses"].cell_data["site"])) == {0, 1, 2, 3}


def test_mesh_values_are_active_and_titled():
    mesh = prisms(capture(), "electrons").to_pyvista()

    assert mesh.active_scalars_name == "electrons / e-"
    assert set(mesh.cell_data.keys()) == {"electrons / e-", "site", "rgb"}


@pytest.mark.slow
@pytest.mark.needs("renderer")
def test_right_click_finds_visible_site():
    taken = capture()
    columns = prisms(taken, "code")
    plot = plotter(columns, size_px=(300, 200), off_screen=True)
    assert "columns" in plot.actors
    assert [title.strip() for title in list(plot.scalar_bars.keys())] == ["code / DN"]
    render3d.add_picking(plot, [columns])
    plot.show(auto_close=False)
    mesh = plot.actors["columns"].mapper.dataset
    own, picked, is_orange = mesh.cell_data["rgb"].copy(), set(), []
    for x, y in itertools.product(range(20, 250, 23), range(20, 190, 17)):
        plot.iren.picker.Pick(x, y, 0, plot.renderer)
        text = plot.actors["picked site"].GetInput()
        cells = np.flatnonzero((mesh.cell_data["rgb"] != own).any(axis=1))
        if text == render3d.PICKING_HINT:
            assert cells.size == 0
            continue
        (site,) = set(mesh.cell_data["site"][cells].tolist())
        assert text == f"site {site}, code {taken.code[site]} DN"
        # The picked site is drawn in orange, shaded, at this pixel, except at edges and behind the text.
        red, green, blue = plot.screenshot(None)[199 - y, x].astype(float)
        is_orange.append(blue < 10.0 and abs(green / red - 140.0 / 255.0) < 0.05)
        picked.add(site)
    assert len(picked) > 20
    assert np.mean(is_orange) > 0.9
    plot.close()


@pytest.mark.slow
@pytest.mark.needs("renderer")
def test_both_renderers_shade_lenses_alike():
    model = solids(fs.layout.grid(n_x=5, n_y=5, pitch_um=3.0), SensorStack(n_lens_corners=16))
    ours, theirs = (
        render(model, size_px=(400, 260), oversampling=2, renderer=name).astype(int) for name in ("software", "pyvista")
    )

    assert np.mean(np.abs(ours - theirs).max(axis=-1) > 6) < 0.02


def test_photograph_colours_are_exact_means():
    layout = fs.Layout.from_rectangles([[1.0, 0.5], [2.5, 1.5]], [[2.0, 1.0], [1.0, 1.0]])
    picture = np.array([[[0, 0, 0], [0, 0, 0], [10, 20, 30]], [[255, 255, 255], [0, 0, 0], [0, 0, 0]]], np.uint8)
    # The first site covers a white and a black pixel of the bottom row: half of the light, sRGB 188.
    assert picture_colours(layout, picture, (0, 0, 3, 2)).tolist() == [[188, 188, 188], [10, 20, 30]]
    assert picture_colours(layout, picture[..., 1], (0, 0, 3, 2))[1].tolist() == [20, 20, 20]
    # A wide picture over a square layout is centred, and its sides are cropped.
    square = fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0)
    wide = np.repeat(np.arange(8, dtype=np.uint8)[np.newaxis] // 2, 4, axis=0)
    assert picture_colours(square, wide).tolist() == [[v] * 3 for v in (1, 2, 1, 2)]
    with pytest.raises(ParameterError, match="'picture' must be uint8 of shape"):
        picture_colours(square, wide / 8.0)


def test_written_picture_equals_returned_one(tmp_path):
    picture = render(prisms(ODD_LAYOUT), tmp_path / "still.png", renderer="software", size_px=(60, 40))

    assert np.array_equal(read_picture(tmp_path / "still.png"), picture)
    with pytest.raises(FileError, match="must end in"):
        render(prisms(ODD_LAYOUT), tmp_path / "still.xyz", renderer="software", size_px=(60, 40))
    assert [path.name for path in tmp_path.iterdir()] == ["still.png"]


# -- PyVista renderer ----------------------------------------------------------------------------------------------------


@pytest.mark.needs("renderer")
@pytest.mark.parametrize("viewpoint", [Viewpoint(), Viewpoint(azimuth_deg=30, elevation_deg=15, zoom=1.7, view_deg=50)])
def test_both_renderers_agree(viewpoint):
    layout = fs.layout.giotto(n_rho=20, n_theta=40, n_fovea=6, n_across=80, unit_um=1.0, chords_per_arc=3)
    response = 2.0 + np.cos(layout.centroid_um[:, 0] / 5.0)
    columns = prisms(layout, response)
    ours, theirs = (
        render(columns, viewpoint=viewpoint, size_px=(400, 260), oversampling=2, renderer=name).astype(int)
        for name in ("software", "pyvista")
    )
    is_ground = [np.all(picture == render3d.BACKGROUND, axis=-1) for picture in (ours, theirs)]

    # Boundaries may lie on either side of a pixel centre; this affects less than one pixel in a hundred.
    assert np.mean(is_ground[0] != is_ground[1]) < 0.005
    assert np.mean(np.abs(ours - theirs).max(axis=-1) > 3) < 0.01


@pytest.mark.needs("renderer")
def test_pyvista_picture_matches_sites_in_view():
    layout = fs.layout.hexagonal(n_columns=12, n_rows=12, pitch_um=2.0)
    n = layout.n_sites
    colours = np.stack((np.arange(n) % 16 * 17, np.arange(n) // 16 * 25, np.full(n, 90)), axis=1).astype(np.uint8)
    columns = prisms(layout, np.random.default_rng(4).random(n), by=colours, max_height_um=0.5)
    site = sites_in_view(columns, viewpoint=STRAIGHT_DOWN, size_px=(500, 400))
    picture = render(columns, viewpoint=STRAIGHT_DOWN, size_px=(500, 400), oversampling=1, renderer="pyvista")
    light = np.array(render3d.LIGHT_DIRECTION) / np.linalg.norm(render3d.LIGHT_DIRECTION)
    roof = np.rint(colours * (render3d.AMBIENT + render3d.DIFFUSE * light[2]))
    is_roof = (site >= 0) & np.all(np.abs(picture - roof[site]) <= 2, axis=-1)

    assert np.count_nonzero(is_roof) > 0.93 * np.count_nonzero(site >= 0)


@pytest.mark.needs("renderer")
def test_ambient_occlusion_darkens_without_edge_artefact():
    layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
    columns = prisms(layout, np.indices((8, 8)).sum(axis=0).ravel() % 2 + 1.0, by=np.full((64, 3), 200, np.uint8))
    plain, shaded = (
        render(columns, size_px=(400, 260), ambient_occlusion=shade, renderer="pyvista").astype(int)
        for shade in (False, True)
    )

    is_ground = np.all(plain == render3d.BACKGROUND, axis=-1)
    assert shaded[~is_ground].mean() < plain[~is_ground].mean() - 1
    assert np.all(shaded[[0, -1]] == render3d.BACKGROUND)
    assert np.all(shaded[:, [0, -1]] == render3d.BACKGROUND)


@pytest.mark.slow
@pytest.mark.needs("renderer")
def test_ambient_occlusion_leaves_plane_unchanged():
    flat = prisms(fs.layout.grid(n_x=40, n_y=40, pitch_um=2.0), np.ones(1600), by=np.full((1600, 3), 200, np.uint8))
    for zoom in (1.0, 4.0):
        viewpoint = Viewpoint(zoom=zoom, focus_um=(0.0, 0.0, 6.0))
        plain, shaded = (
            render(flat, viewpoint=viewpoint, size_px=(400, 260), ambient_occlusion=shade, renderer="pyvista").astype(
                int
            )
            for shade in (False, True)
        )
        inside = (slice(90, 170), slice(150, 250))

        # All except single pixels between two prisms; with a fifth of the bias all tops are hatched.
        assert np.mean(plain[inside] == np.median(plain[inside])) > 0.998
        assert np.mean(np.abs(shaded - plain)[inside] <= 1) > 0.998


@pytest.mark.needs("renderer")
def test_show_raises_without_screen(monkeypatch):
    monkeypatch.setattr(render3d, "find_renderer", lambda: renderer.EGL)

    with pytest.raises(SimulationError, match="no screen to open a window on; write a picture with"):
        show(prisms(ODD_LAYOUT))


@pytest.mark.parametrize("missing", ["", "this machine has no OpenGL; install it"])
def test_notebooks_without_screen_show_a_picture(monkeypatch, missing):
    shown = []
    monkeypatch.setattr(render3d, "missing_software", lambda: missing)
    monkeypatch.setattr(render3d, "find_renderer", lambda: None)
    monkeypatch.setattr(render3d, "is_notebook", lambda: True)
    monkeypatch.setattr(render3d, "display", shown.append)
    monkeypatch.setattr(render3d, "render", lambda scene, **options: render(scene, **options, renderer="software"))
    ODD_LAYOUT.plot3d(size_px=(300, 200))

    assert [picture.size for picture in shown] == [(300, 200)]
    assert np.array_equal(shown[0], render(ODD_LAYOUT, size_px=(300, 200), renderer="software"))


# -- missing software ----------------------------------------------------------------------------------------------------


def test_missing_renderer_warns_and_uses_software(monkeypatch):
    monkeypatch.setattr(render3d, "missing_software", lambda: "this machine has no OpenGL; install it")
    columns = prisms(ODD_LAYOUT)

    with pytest.warns(FoveasimWarning, match="no OpenGL; install it; the software renderer is used"):
        picture = render(columns, size_px=(60, 40), ambient_occlusion=True)
    assert np.array_equal(picture, render(columns, size_px=(60, 40), renderer="software"))
    with pytest.raises(SimulationError, match="no OpenGL; install it"):
        render(columns, renderer="pyvista")
    with pytest.raises(SimulationError, match="no OpenGL; install it"):
        show(columns)


#: Environments that emulate missing software: no driver, a library without its drivers, an invalid display.
MACHINES = {
    "no EGL driver": {"__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
    "EGL without OpenGL drivers": {"LIBGL_DRIVERS_PATH": "/nonexistent", "GBM_BACKENDS_PATH": "/nonexistent"},
    "invalid display": {"DISPLAY": ":77", "__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
    "invalid window class": {renderer.VTK_VARIABLE: "vtkNoRenderWindow", "__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
    "window class without its library": {renderer.VTK_VARIABLE: renderer.OSMESA, "__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
}  # fmt: skip
RENDER_SCRIPT = """
import warnings
import numpy as np
import foveasim as fs
from foveasim.errors import FoveasimWarning
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    picture = fs.view.render(fs.view.prisms(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)), size_px=(60, 40))
print(fs.view.find_renderer(), len(np.unique(picture)) > 2, *[w.message for w in caught if w.category is FoveasimWarning], sep="|")
"""


@pytest.mark.slow
@pytest.mark.parametrize("machine", MACHINES)
def test_missing_drivers_do_not_crash_interpreter(machine):
    bare = {k: v for k, v in os.environ.items() if k not in {"DISPLAY", renderer.VTK_VARIABLE}}
    run = subprocess.run(
        [sys.executable, "-c", RENDER_SCRIPT],
        env={**bare, **MACHINES[machine]},
        capture_output=True,
        text=True,
        check=False,
    )
    found, is_drawn, *messages = run.stdout.strip().split("|")

    assert (run.returncode, is_drawn) == (0, "True")
    # A library of another kind is found if it is installed; otherwise one message names the missing packages.
    assert [bool(found == "None")] == [len(messages) == 1]
    assert all("apt install libegl1 libgl1" in message for message in messages)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("outcome", ["crashes", "raises", "hangs"])
def test_failed_trial_gives_no_renderer(outcome, monkeypatch):
    trials = {
        "crashes": "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
        "raises": "1 / 0",
        "hangs": "import time; time.sleep(60)",
    }
    monkeypatch.setattr(renderer, "TRIAL", trials[outcome])
    monkeypatch.setattr(renderer, "TRIAL_S", 0.5 if outcome == "hangs" else 60.0)
    monkeypatch.setattr(renderer, "_candidates", lambda: iter([renderer.EGL, renderer.OSMESA]))

    assert renderer.find_renderer.__wrapped__() is None


def test_first_working_window_is_used(monkeypatch):
    monkeypatch.setattr(renderer, "_candidates", lambda: iter([renderer.X11, renderer.EGL, renderer.OSMESA]))
    monkeypatch.setattr(renderer, "_can_render", lambda window: window == renderer.EGL)

    assert renderer.find_renderer.__wrapped__() == renderer.EGL


def test_missing_libraries_give_no_candidates(monkeypatch):
    for variable in ("DISPLAY", renderer.VTK_VARIABLE):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(renderer, "_load_library", lambda _: None)
    monkeypatch.setattr(sys, "platform", "linux")
    assert list(renderer._candidates()) == []

    monkeypatch.setenv("DISPLAY", ":0")
    assert list(renderer._candidates()) == []

    monkeypatch.setattr(renderer, "_load_library", lambda name: object() if name == "libOSMesa.so.8" else None)
    assert list(renderer._candidates()) == [renderer.OSMESA]


def test_missing_pyvista_message_names_command(monkeypatch):
    monkeypatch.setattr(renderer, "find_spec", lambda _: None)

    assert renderer.missing_software() == "rendering needs pyvista; install it with: pip install 'foveasim[view]'"
    assert renderer.find_renderer.__wrapped__() is None


def test_mesh_repr_shows_triangle_count():
    assert repr(prisms(fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0))) == "Mesh('columns', 20 triangles)"
    assert isinstance(prisms(ODD_LAYOUT), Mesh)
