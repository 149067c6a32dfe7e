"""Layouts: generation, adjacency, design rules and files, in seconds for 10^6 sites and as ratios to other libraries."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gdstk
import klayout.db as kdb
import numpy as np
import shapely
from report import Report, best_s

from foveasim.layout import DesignRules, Layout, Readout, Routing, grid, hexagonal, log_polar, read_layout

#: Sites for other libraries: the slowest takes 1 ms per site.
PEER_SITES, SLOW_PEER_SITES = 100_000, 5_000
DBU_UM = 1e-3
#: Log-polar sites in files, for a million sites elsewhere, and sectors of each ring.
RING_SITES, RING_SECTORS = 30_000, 240


def bench_layouts(report: Report, n_sites: int) -> None:
    """Measure ``foveasim.layout`` on hexagons and log-polar rings of ``n_sites``."""
    side = round(n_sites**0.5)
    hexagons = hexagonal(n_columns=side, n_rows=side, pitch_um=3.0)
    rings = log_polar(n_sectors=side, n_rings=side, r_min_um=1000.0, r_max_um=6500.0)
    _seconds(report, side, hexagons, rings)
    few = hexagonal(n_columns=250, n_rows=PEER_SITES // 250, pitch_um=3.0, trench_um=0.3)
    _against_klayout(report, few)
    _against_loops(report, few[:SLOW_PEER_SITES], hexagons[:SLOW_PEER_SITES])
    _against_gdstk(report, "squares", grid(n_x=side, n_y=side, pitch_um=2.2), (0.7, 0.07))
    n_rings = round(n_sites * RING_SITES / 1e6 / RING_SECTORS)
    rings = log_polar(n_sectors=RING_SECTORS, n_rings=n_rings, r_min_um=100.0, r_max_um=3000.0)
    _against_gdstk(report, "log-polar sites", rings, (0.1, 0.01))


def every_rule(layout: Layout, **changes: Any) -> DesignRules:
    """Return limits for every rule; the layouts satisfy all but those of gaps."""
    x0, y0, x1, y1 = layout.bounds_um
    limits: dict[str, Any] = {
        "min_size_um": 0.1, "max_size_um": 1e3, "min_area_um2": 0.1, "min_hole_um2": 0.1, "min_width_um": 0.1,
        "min_space_um": 0.1, "max_aspect_ratio": 50.0, "min_angle_deg": 20.0, "edge_angle_step_deg": 1e-4,
        "grid_um": 1e-6, "max_overlap_um2": 0.0, "max_gap_um2": 0.0, "die_um": (x0 - 1.0, y0 - 1.0, x1 + 1.0, y1 + 1.0),
        "max_neighbour_ratio": 3.0, "max_sites": 10**9, "min_density": 0.0, "max_density": 1.0,
        "density_window_um": 400.0, "max_data_rate_gbit_per_s": 1e6, "readout": Readout(frames_per_s=30.0, bits=10),
        "max_track_utilisation": 1e6, "routing": Routing(width_um=0.14, space_um=0.14),
        "waivers": {"max_gap_um2": "the die around it"},
    }  # fmt: skip
    if "ring" in layout.columns:
        limits |= {"min_growth": 0.9, "max_growth": 1.1}
    return DesignRules(**(limits | changes))


def _seconds(report: Report, side: int, hexagons: Layout, rings: Layout) -> None:
    n = f"{side * side:,}"
    # The first call compiles kernels.
    small = hexagons[:100]
    small.adjacency()
    small.check(every_rule(small))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hexagons.gds"

        def write_and_read() -> None:
            hexagons.write(path)
            read_layout(path)

        calls = {
            "log_polar": (lambda: log_polar(n_sectors=side, n_rings=side, r_min_um=1000.0, r_max_um=6500.0), 2, 3),
            "hexagonal": (lambda: hexagonal(n_columns=side, n_rows=side, pitch_um=3.0), 2, 3),
            "adjacency of hexagons": (lambda: _fresh(hexagons).adjacency(), 10, 2),
            "adjacency of rings": (lambda: _fresh(rings).adjacency(), 10, 2),
            "every rule on hexagons": (lambda: _fresh(hexagons).check(every_rule(hexagons)), 20, 2),
            "every rule on rings": (lambda: _fresh(rings).check(every_rule(rings)), 20, 2),
            "GDSII write + read": (write_and_read, 20, 1),
        }
        for name, (call, at_most, repeats) in calls.items():
            s = best_s({name: call}, repeats)[name]
            report.seconds(f"{name}, {n} sites", s, at_most)


def _fresh(layout: Layout) -> Layout:
    """Return a copy of the layout without cached properties."""
    return Layout(layout.xy_um, layout.ring_offsets, layout.site_offsets, layout.columns)


def _against_klayout(report: Report, layout: Layout) -> None:
    corners = np.rint(layout.xy_um / DBU_UM).astype(int).reshape(layout.n_sites, -1, 2).tolist()
    region = kdb.Region([kdb.Polygon([kdb.Point(x, y) for x, y in ring]) for ring in corners])
    region.merged_semantics = False
    size, n = round(2.5 / DBU_UM), f"{layout.n_sites:,} hexagons"
    times = best_s(
        {
            "width": lambda: _fresh(layout).check(DesignRules(min_width_um=2.5)),
            "k width": lambda: region.width_check(size, False, kdb.Metrics.Euclidian, 80.0).count(),
            "space": lambda: _fresh(layout).check(DesignRules(min_space_um=0.25)),
            "k space": lambda: region.space_check(round(0.25 / DBU_UM), False, kdb.Metrics.Euclidian, 80.0).count(),
        },
        3,
    )
    report.faster_than(f"minimum width, {n}", times["width"], "klayout width_check", times["k width"], 7)
    report.faster_than(f"minimum space, {n}", times["space"], "klayout space_check", times["k space"], 7)


def _against_gdstk(report: Report, what: str, layout: Layout, at_least: tuple[float, float]) -> None:
    """Compare sizes and times of GDSII files with gdstk's own writer and reader, with a polygon per site without properties."""
    with tempfile.TemporaryDirectory() as folder:
        ours, peer = Path(folder) / "ours.gds", Path(folder) / "peer.gds"

        def write_with_gdstk() -> None:
            library = gdstk.Library(unit=1e-6, precision=DBU_UM * 1e-6)
            rings = np.split(layout.xy_um, layout.ring_offsets[1:-1])
            library.new_cell("SENSOR").add(*(gdstk.Polygon(ring, 1) for ring in rings))
            library.write_gds(peer)

        def read_with_gdstk() -> list[Any]:
            return [polygon.points for polygon in gdstk.read_gds(peer).top_level()[0].polygons]

        times = best_s(
            {
                "write": lambda: layout.write(ours),
                "write peer": write_with_gdstk,
                "read": lambda: read_layout(ours),
                "read peer": read_with_gdstk,
            },
            2,
        )
        n_bytes, n_peer_bytes = ours.stat().st_size, peer.stat().st_size
    n = f"{layout.n_sites:,} {what}"
    report.faster_than(f"GDSII write, {n}", times["write"], "gdstk, polygons", times["write peer"], at_least[0])
    report.faster_than(f"GDSII read and check, {n}", times["read"], "gdstk.read_gds", times["read peer"], at_least[1])
    sizes = (f"{n_bytes / 1e3:,.4g} kB", "gdstk, polygons", f"{n_peer_bytes / 1e3:,.4g} kB")
    report.add(f"GDSII file, {n}", *sizes, n_bytes / n_peer_bytes, None)


def _against_loops(report: Report, apart: Layout, abutting: Layout) -> None:
    """Compare with loops over shapely polygons."""

    def adjacency_by_loop() -> float:
        polygons = abutting.polygons()
        tree = shapely.STRtree(polygons)
        total_um = 0.0
        for i, polygon in enumerate(polygons):
            for j in tree.query(polygon, predicate="intersects"):
                if i < j:
                    total_um += polygon.boundary.intersection(polygons[j].boundary).length
        return total_um

    def spaces_by_loop() -> int:
        polygons = apart.polygons()
        tree = shapely.STRtree(polygons)
        return sum(
            0.0 < polygon.distance(polygons[j]) < 0.25
            for i, polygon in enumerate(polygons)
            for j in tree.query(polygon.buffer(0.25))
            if i < j
        )

    def shapes_by_loop() -> list[Any]:
        return [shapely.Polygon(ring) for ring in apart.xy_um.reshape(apart.n_sites, -1, 2)]

    n = f"{apart.n_sites:,} hexagons"
    side = round(apart.n_sites**0.5)
    times = best_s(
        {
            "make": lambda: hexagonal(n_columns=side, n_rows=side, pitch_um=3.0),
            "make loop": shapes_by_loop,
            "adjacency": lambda: _fresh(abutting).adjacency(),
            "adjacency loop": adjacency_by_loop,
            "space": lambda: _fresh(apart).check(DesignRules(min_space_um=0.25)),
            "space loop": spaces_by_loop,
        },
        3,
    )
    report.faster_than(
        f"hexagonal, {side * side:,} sites", times["make"], "loop of shapely.Polygon", times["make loop"], 10
    )
    report.faster_than(f"adjacency, {n}", times["adjacency"], "loop over shapely", times["adjacency loop"], 10)
    report.faster_than(f"minimum space, {n}", times["space"], "loop over shapely", times["space loop"], 10)
