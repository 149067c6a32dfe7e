"""
Edits of layouts.

Each edit returns a new layout: sites retain their columns, and the provenance records the step. Regions and outlines are
shapely polygons or vertices in µm. Edits are registered in :data:`foveasim.layout.EDITS`; settings files list them in
``layout.edits``.
"""

from __future__ import annotations

from foveasim._core.registry import import_all
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.model import Layout

import_all(__name__, __path__)

for _edit, _example in (
    (Layout.translate, {"dx_um": 1.0, "dy_um": 2.0}),
    (Layout.rotate, {"angle_deg": 30.0}),
    (Layout.scale, {"factor": 2.0}),
):
    setattr(Layout, _edit.__name__, layout_edit(example=_example)(_edit))
