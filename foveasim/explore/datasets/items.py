"""Items of samples: dimensions, units, and conversion to named arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from foveasim.columns import COLUMNS, column_info
from foveasim.explore.datasets.images import CORTICAL, RASTER, image_units

__all__ = ["SETTINGS", "Item", "describe_items", "flatten", "unflatten"]

#: Item with the random settings of a sample, and prefix of their names.
SETTINGS = "settings"


class Item(NamedTuple):
    """Dimensions of an item of a sample, and its unit (``"1"``: dimensionless)."""

    dimensions: tuple[str, ...] = ()
    units: str = "1"


#: Items that are not dimensionless numbers or strings, except for columns of photosites. The units of images follow from their
#: options.
ITEMS = {
    "box_um": Item(("box", "bound"), "µm"),
    "box_label": Item(("box",)),
    "box_covers": Item(("box", "site")),
    "mask": Item(("site",)),
    "flow_um": Item(("site", "axis"), "µm"),
    "flow_known": Item(("site",)),
    RASTER: Item(("raster_channel", "raster_y", "raster_x")),
    f"{RASTER}_known": Item(("raster_y", "raster_x")),
    CORTICAL: Item(("cortical_channel", "ring", "sector")),
    f"{CORTICAL}_known": Item(("ring", "sector")),
}


def flatten(sample: Mapping[str, Any]) -> dict[str, Any]:
    """Return a sample with its random settings as separate items."""
    own = {f"{SETTINGS}/{path}": value for path, value in sample[SETTINGS].items()}
    return {name: value for name, value in sample.items() if name != SETTINGS} | own


def unflatten(items: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sample with the given separate items, the inverse of :func:`flatten`."""
    prefix = f"{SETTINGS}/"
    sample = {name: value for name, value in items.items() if not name.startswith(prefix)}
    settings = {name.removeprefix(prefix): value for name, value in items.items() if name.startswith(prefix)}
    return sample | {SETTINGS: settings}


def describe_items(sample: Mapping[str, Any], images: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """
    Return the dimensions, shape, type and unit of each item, as plain data.

    ``images`` are the options of the images by name.
    """
    found = {}
    for name, value in flatten(sample).items():
        item = Item(("site",), column_info(name).unit or "1") if name in COLUMNS else ITEMS.get(name, Item())
        is_string = isinstance(value, str)
        found[name] = {
            "dimensions": list(item.dimensions),
            "shape": list(np.shape(value)),
            "dtype": "str" if is_string else str(np.asarray(value).dtype),
            "units": image_units(images[name]) if name in images else item.units,
        }
    return found
