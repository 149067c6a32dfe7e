"""Checks of layout generators, edits, design rules and derived layers."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import shapely
import yaml

from foveasim._core.provenance import to_plain_data
from foveasim.config import read_layout
from foveasim.layout import DERIVED_LAYERS, EDITS, LAYOUTS, RULES, DesignRules, Layout, LayoutLayer, mosaic
from foveasim.layout._noding import intersections
from foveasim.layout.files._derived import shapes_of_layout, shapes_of_sites
from foveasim.testing._extension import Extension, check_of, require, shot_with, square_grid

#: Relative tolerance of areas.
AREA_TOLERANCE = 1e-9
#: Displacement by which derived layers are compared, µm: coordinates of the grid remain exact.
STEP_UM = 16.0


def _check_sites(layout: object, *, may_overlap: bool = False) -> Layout:
    """Return a layout after checking that its sites are polygons with areas."""
    require(isinstance(layout, Layout), f"must return a Layout, got {type(layout).__name__}")
    assert isinstance(layout, Layout)
    require(layout.n_sites > 0, "must return at least one site")
    polygons = layout.polygons()
    invalid = np.flatnonzero(~shapely.is_valid(polygons) | ~(layout.area_um2 > 0.0))
    require(invalid.size == 0, f"has sites that are not simple polygons with an area, the first is {invalid[:1]}")
    rebuilt = Layout.from_polygons((layout.xy_um, layout.ring_offsets, layout.site_offsets))
    require(
        np.array_equal(rebuilt.xy_um, layout.xy_um),
        "must have counter-clockwise outlines and clockwise holes without repeated vertices; use Layout.from_polygons()",
    )
    if not may_overlap:
        first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
        pairs = first < second
        min_um2 = AREA_TOLERANCE * layout.area_um2.min()
        common = intersections(polygons[first[pairs]], polygons[second[pairs]], min_um2)
        worst = shapely.area(common).max(initial=0.0)
        require(worst <= min_um2, f"has sites that overlap, by up to {worst:.4g} µm²")
    return layout


def _is_same(one: Layout, other: Layout) -> bool:
    return (
        one.xy_um.shape == other.xy_um.shape
        and np.array_equal(one.xy_um, other.xy_um)
        and np.array_equal(one.site_offsets, other.site_offsets)
        and one.columns.keys() == other.columns.keys()
        and all(
            column.dtype == other.columns[name].dtype and np.array_equal(column, other.columns[name])
            for name, column in one.columns.items()
        )
    )


@check_of(LAYOUTS)
def check_generator(extension: Extension) -> None:
    """Check the sites of a generator, their reproduction, and files."""
    layout = _check_sites(extension.make())
    require(_is_same(extension.make(), layout), "must return the same layout for the same parameters")
    _check_lengths(extension, layout)
    provenance = layout.provenance
    require(
        provenance.get("generator") == extension.name,
        "must record its name in the provenance; decorate it with layout_generator",
    )
    parameters = provenance["parameters"]
    missing = set(inspect.signature(extension.item).parameters) - set(parameters)
    require(not missing, f"must record its parameters in the provenance, {sorted(missing)} are missing")

    layout.write(extension.directory / "layout.npz")
    require(
        _is_same(read_layout(extension.directory / "layout.npz"), layout), "must be the same after writing and reading"
    )
    if getattr(extension.item, "picture", None) is None:  # pictures are not recorded
        require(
            _is_same(extension.item(**parameters), layout), "must be reproduced by the parameters in its provenance"
        )
        settings = {"generator": extension.name, "parameters": to_plain_data(extension.parameters)}
        path = extension.directory / "layout.yaml"
        path.write_text(yaml.safe_dump(settings), encoding="utf-8")
        require(_is_same(read_layout(path), layout), "must be the same in a settings file")


def _check_lengths(extension: Extension, layout: Layout) -> None:
    """Check that the coordinates are proportional to the lengths among the parameters."""
    defaults = {name: each.default for name, each in inspect.signature(extension.item).parameters.items()}
    parameters = {name: value for name, value in defaults.items() if isinstance(value, float)} | extension.parameters
    lengths = {name: value for name, value in parameters.items() if name.endswith("_um") and value is not None}
    doubled = {name: (2.0 * np.asarray(value, np.float64)).tolist() for name, value in lengths.items()}
    larger = extension.make(**doubled)
    is_proportional = larger.xy_um.shape == layout.xy_um.shape and np.allclose(
        larger.xy_um, 2.0 * layout.xy_um, rtol=0.0, atol=AREA_TOLERANCE * np.abs(layout.xy_um).max()
    )
    require(is_proportional, f"must have twice the coordinates for twice the lengths {sorted(lengths)}")


@check_of(EDITS)
def check_edit(extension: Extension) -> None:
    """Check the sites of an edited grid of squares, the record, and settings files."""
    before = mosaic(square_grid(), ["RG", "GB"])
    xy_um = before.xy_um.copy()
    edited = _check_sites(extension.make(before))
    require(np.array_equal(before.xy_um, xy_um), "must not change its argument")
    require(_is_same(extension.make(before), edited), "must return the same layout for the same parameters")
    require(edited.channel.shape == (edited.n_sites,), "must preserve the column 'channel'")
    n_before, n_after = (len(layout.provenance.get("steps", ())) for layout in (before, edited))
    is_recorded = _is_same(edited, before) or n_after > n_before
    require(is_recorded, "must record the step in the provenance, in the list 'steps'; use Layout.with_provenance()")
    if not any(isinstance(value, Layout | DesignRules) for value in extension.parameters.values()):
        shot = shot_with("layout", {"mosaic": ["RG", "GB"], "edits": [extension.settings]})
        by_file: Any = shot.camera.sensor.layout
        require(_is_same(by_file, edited), "must be the same in a settings file")


@check_of(RULES)
def check_rule(extension: Extension) -> None:
    """Check that limits of a rule are satisfied and violated."""
    further = extension.parameters
    layout = further.pop("layout", square_grid)()
    require(
        {"satisfied", "violated"} <= further.keys(),
        "has no limits that are satisfied and violated; register it with example={'satisfied': ..., 'violated': ...}",
    )
    limits = {is_ok: further.pop(key) for key, is_ok in (("satisfied", True), ("violated", False))}
    require(extension.item.description, "must have a description")
    for is_ok, limit in limits.items():
        name = extension.name
        own = {name: limit} if hasattr(DesignRules(), name) else {"custom": {name: limit}}
        report = layout.check(DesignRules(**own, **further))
        found = [violation for violation in report.violations if violation.rule == name]
        require(
            bool(found) != is_ok,
            f"must {'not ' * is_ok}be violated by the limit {limit} of its example; check is_upper and the measurement",
        )
        for violation in found:
            require(
                shapely.is_geometry(violation.marker) and not shapely.is_empty(violation.marker), "must have markers"
            )
            require(all(0 <= site < layout.n_sites for site in violation.site_ids), "must have indices of sites")
            if not extension.item.is_deviation:
                excess = extension.item.excess(np.array([violation.value]), violation.limit)[0]
                require(
                    excess > 0.0, f"has the violation {violation.value:.4g} within its limit {limit}; check is_upper"
                )


@check_of(DERIVED_LAYERS)
def check_derived_layer(extension: Extension) -> None:
    """Check the polygons of a derived layer, also of displaced and of single sites."""
    layout, moved = square_grid(), square_grid().translate(STEP_UM, -STEP_UM)
    is_complete = isinstance(extension.item, LayoutLayer)

    def polygons(of: Layout) -> list[shapely.Geometry]:
        if is_complete:
            placed = shapes_of_layout(extension.name, of, extension.parameters)
            shapes = placed.polygons[placed.shape]
            return [shapely.affinity.translate(each, *by) for each, by in zip(shapes, placed.position_um, strict=True)]
        return list(shapes_of_sites(extension.name, of, extension.parameters))

    found = polygons(layout)
    extension.make(layout)
    require(all(each.is_valid and each.area > 0.0 for each in found), "must return valid polygons with an area")
    again = [shapely.affinity.translate(each, STEP_UM, -STEP_UM) for each in found]
    there = polygons(moved)
    require(
        shapely.union_all(again).symmetric_difference(shapely.union_all(there)).area <= AREA_TOLERANCE,
        "must move with the layout",
    )
    if not is_complete:
        alone = polygons(layout[5:6])[0]
        require(
            alone.symmetric_difference(found[5]).area <= AREA_TOLERANCE,
            "must depend on the outline of each site only, because congruent sites are drawn once; use LayoutLayer",
        )
    area_um2 = shapely.union_all(found).area
    require(
        extension.expected is not None,
        "has no known area; register it with expected=, the area in µm² for 4 x 4 squares of 10 µm",
    )
    require(
        abs(area_um2 - extension.expected) <= 1e-6 * extension.expected,
        f"has {area_um2:.6g} µm², expected {extension.expected:.6g} µm²; check the sign of offsets",
    )
