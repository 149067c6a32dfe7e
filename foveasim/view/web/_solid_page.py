"""Page of a sensor in three dimensions, with the values of the site under the mouse."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from foveasim.capture import Capture
from foveasim.layout import Layout
from foveasim.view.meshes import Mesh, prisms
from foveasim.view.solids import Solids
from foveasim.view.solids import solids as solids_of
from foveasim.view.web._bodies import bodies_of
from foveasim.view.web._content import describe_sites
from foveasim.view.web._pack import pack
from foveasim.view.web._page import assemble_page, write_page

#: Photosites above which lenses of one colour look like a blank sheet.
MAX_WHITE_SITES = 1000


def solid_page(data: Layout | Capture, *, solids: Solids | None = None, name: str = "") -> str:
    """
    Return a page to explore a sensor in three dimensions in a browser.

    Parameters
    ----------
    data : Layout or Capture
    solids : Solids, optional
        Solids of the photosites of this data. By default the parts of a layout, from :func:`foveasim.view.solids`, or the
        photosites of a capture as prisms whose heights are their codes, in the colours of a colour picture. Many photosites
        without filters are coloured by size.
    name : str
        Heading; by default the generator of the layout.

    Returns
    -------
    text : str
        Self-contained HTML for a browser with WebGL2; it loads no other resources.

    Raises
    ------
    ParameterError
        When the data is neither, or the solids are not of its photosites with one colour per site and part.
    GeometryError
        When there is nothing to show.

    Examples
    --------
    >>> import foveasim as fs
    >>> page = fs.view.solid_page(
    ...     fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), name="four photosites"
    ... )
    >>> "<title>four photosites</title>" in page
    True
    """
    about, arrays, layout = describe_sites(data, name=name)
    if solids is None and isinstance(data, Capture):
        meshes: Sequence[Mesh] = (prisms(data, has_floor=True),)
        shown = "Column heights show the codes."
        if meshes[0].shown is not None and meshes[0].shown.values is None:
            about["ownColours"] = "of the picture"
        else:
            about["colouring"] = about["columns"][0]["key"]
    else:
        meshes = (solids_of(data) if solids is None else solids).meshes
        shown = "z points toward the lens."
        if (
            solids is None
            and layout.n_sites > MAX_WHITE_SITES
            and not np.ptp(layout.channel)
            and np.ptp(layout.area_um2)
        ):
            about["colouring"] = "size_um"
    bodies, surfaces = bodies_of(meshes, layout)
    arrays |= {**surfaces, "area_um2": layout.area_um2}
    packed = {key: pack(values) for key, values in arrays.items()}
    return assemble_page(
        "solid.html",
        ("page.css",),
        "solid.js",
        {**about, "bodies": bodies, "arrays": {key: kind for key, (kind, _) in packed.items()}},
        {key: text for key, (_, text) in packed.items()},
        title=str(about["name"]),
        shown=shown,
    )


def write_solid_page(data: Layout | Capture, path: str | Path, *, solids: Solids | None = None, name: str = "") -> None:
    """
    Write :func:`solid_page` to a file atomically.

    Parameters
    ----------
    data : Layout or Capture
    path : path
        With the extension ``.html``.
    solids : Solids, optional
    name : str
        Heading; by default the generator of the layout.

    Raises
    ------
    FileError
        When the extension is another, or the file cannot be written.
    ParameterError, GeometryError
        As for :func:`solid_page`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "grid.html")
    ...     fs.view.write_solid_page(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), path)
    ...     print(path.read_text("utf-8")[:15])
    <!doctype html>
    """
    write_page(path, lambda: solid_page(data, solids=solids, name=name))
