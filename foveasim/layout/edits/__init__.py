"""
Edits of layouts.

Each edit returns a new layout: sites retain their columns, and the provenance records the step. Regions and outlines are
shapely polygons or vertices in µm. Edits are registered in :data:`EDITS`; settings files list them in ``layout.edits``.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.layout.edit_registry import EDITS, layout_edit
from foveasim.layout.edits.all_sites import (
    clip,
    cut_out,
    inset,
    joining_groups,
    merge,
    merge_small,
    node,
    snap,
    split,
    union,
)
from foveasim.layout.edits.at_points import (
    cut_along,
    merge_at,
    move_sites,
    move_vertices,
    remove_at,
    remove_vertices,
    set_channel,
    sites_at,
    split_at,
)
from foveasim.layout.edits.layers import draw, overlay
from foveasim.layout.model import Layout

__all__ = [
    "EDITS",
    "clip",
    "cut_along",
    "cut_out",
    "draw",
    "inset",
    "joining_groups",
    "layout_edit",
    "merge",
    "merge_at",
    "merge_small",
    "move_sites",
    "move_vertices",
    "node",
    "overlay",
    "remove_at",
    "remove_vertices",
    "set_channel",
    "sites_at",
    "snap",
    "split",
    "split_at",
    "union",
]

for _edit, _example in (
    (Layout.translate, {"dx_um": 1.0, "dy_um": 2.0}),
    (Layout.rotate, {"angle_deg": 30.0}),
    (Layout.scale, {"factor": 2.0}),
):
    layout_edit(example=_example)(_edit)

publish(__name__)
