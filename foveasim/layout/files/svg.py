"""
Layouts as SVG drawings: one filled path per site.

Holes use the even-odd rule, and y points up. The format is write-only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from foveasim._core.validation import check_count
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat
from foveasim.errors import ParameterError
from foveasim.layout.files._common import FORMATS, WrittenLayout, rounding_report
from foveasim.layout.model import Layout

__all__ = ["write"]

#: Decimal places of coordinates in µm: a resolution of a tenth of a nanometre.
DECIMALS = 4
#: Longer side of the drawing, in CSS pixels.
DRAWING_PX = 1000
DEFAULT_COLOUR = "#9a9a9a"
#: CSS colour names, #rgb and #rrggbb; quotation marks would end the XML attribute.
COLOUR = re.compile(r"#[0-9a-fA-F]{3}|#[0-9a-fA-F]{6}|[a-zA-Z]{3,24}")
#: Number of sites formatted at a time.
CHUNK = 10_000


def write(layout: Layout, path: Path, *, colours: Mapping[int, str] | None = None) -> WrittenLayout:
    """Write the layout as a drawing."""
    colours = _validate_colours(colours or {})
    x_min, y_min, x_max, y_max = layout.bounds_um if layout.n_sites else (0.0, 0.0, 1.0, 1.0)
    width_um, height_um = x_max - x_min, y_max - y_min
    px_per_um = DRAWING_PX / max(width_um, height_um)
    fills = [colours.get(c, DEFAULT_COLOUR) for c in layout.channel.tolist()]
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_um * px_per_um:.3f}" '
            f'height="{height_um * px_per_um:.3f}" '
            f'viewBox="{x_min:.{DECIMALS}f} {-y_max:.{DECIMALS}f} {width_um:.{DECIMALS}f} {height_um:.{DECIMALS}f}">\n'
            f"<title>{layout.n_sites} photosites, 1 unit is 1 µm</title>\n"
            '<g transform="scale(1,-1)" fill-rule="evenodd" stroke="none">\n'
        )
        for start in range(0, layout.n_sites, CHUNK):
            outlines = _path_data(layout[start : start + CHUNK])
            file.writelines(f'<path id="site{i}" fill="{fills[i]}" d="{d}"/>\n' for i, d in enumerate(outlines, start))
        file.write("</g>\n</svg>\n")
    return rounding_report(layout, np.round(layout.xy_um, DECIMALS), path, tuple(sorted(layout.columns)))


def _validate_colours(colours: Mapping[int, str]) -> dict[int, str]:
    validated = {}
    for channel, colour in colours.items():
        if not isinstance(colour, str) or not COLOUR.fullmatch(colour):
            raise ParameterError(
                f"colours[{channel!r:.20}]",
                "must be a CSS colour name, #rgb or #rrggbb",
                colour,
                hint='use "#c23b22" or "green"',
            )
        validated[check_count("colours", channel, at_least=0)] = colour
    return validated


def _path_data(layout: Layout) -> list[str]:
    """Return the path data of each site, with all rings closed."""
    n_vertices = layout.xy_um.shape[0]
    point = f"%.{DECIMALS}f %.{DECIMALS}f"
    parts = np.full(n_vertices, "L" + point, dtype=object)
    parts[layout.ring_offsets[:-1]] = "M" + point
    parts[layout.ring_offsets[1:] - 1] += "Z"
    parts[layout.ring_offsets[layout.site_offsets[1:]] - 1] += "\n"
    # Adding 0 converts -0 to 0.
    numbers = np.round(layout.xy_um, DECIMALS) + 0.0
    return ("".join(parts) % tuple(numbers.ravel().tolist())).splitlines()


FORMATS.register("svg", FileFormat(title="SVG", suffixes=(".svg",), write=write, write_options=("colours",)))
