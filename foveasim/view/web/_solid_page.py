"""The page of solids: a sensor in three dimensions, from glTF, with the values of the photosite under the mouse."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from foveasim.capture import Capture
from foveasim.files import written_whole
from foveasim.layout import Layout
from foveasim.view.meshes import Mesh, prisms
from foveasim.view.solids import Solids, write_meshes
from foveasim.view.solids import solids as solids_of
from foveasim.view.web._content import described_sites
from foveasim.view.web._pack import packed
from foveasim.view.web._page import check_page_path, joined

__all__ = ["solid_page", "write_solid_page"]

#: Scripts in the order in which they stand on each other.
SCRIPTS = ("three/three.min.js", "unpack.js", "colours.js", "map.js", "solid.js")


def solid_page(thing: Layout | Capture, *, solids: Solids | None = None, name: str = "") -> str:
    """
    A page to turn a sensor round in a browser.

    Parameters
    ----------
    thing : Layout or Capture
    solids : Solids, optional
        What is shown, with the photosites of this thing. By default the parts of a layout, as :func:`foveasim.view.solids`
        makes them; of a capture its photosites as columns, as high as their codes.
    name : str
        Heading; by default what made the layout.

    Returns
    -------
    text : str
        HTML with everything in it, three.js included; it loads nothing from anywhere.

    Raises
    ------
    ParameterError
        When the thing is neither, or trimesh is not installed.
    GeometryError
        When there is nothing to show.
    """
    about, arrays, layout = described_sites(thing, name=name)
    if solids is None and isinstance(thing, Capture):
        meshes: Sequence[Mesh] = (prisms(thing),)
        shown = "The columns are as high as the codes."
    else:
        meshes = (solids_of(thing) if solids is None else solids).meshes
        shown = "z is toward the lens."
    with tempfile.TemporaryDirectory() as folder:
        write_meshes(meshes, Path(folder) / "solids.glb")
        arrays["glb"] = np.frombuffer((Path(folder) / "solids.glb").read_bytes(), np.uint8)
    arrays["area_um2"] = layout.area_um2
    told = {key: packed(values) for key, values in arrays.items()}
    return joined(
        "solid.html",
        ("page.css",),
        SCRIPTS,
        {**about, "arrays": {key: kind for key, (kind, _) in told.items()}},
        {key: text for key, (_, text) in told.items()},
        title=str(about["name"]),
        shown=shown,
    )


def write_solid_page(
    thing: Layout | Capture, path: str | Path, *, solids: Solids | None = None, name: str = ""
) -> None:
    """
    Write :func:`solid_page` to a file, whole or not at all.

    Parameters
    ----------
    thing : Layout or Capture
    path : path
        Ending in ``.html``.
    solids : Solids, optional
    name : str
        Heading; by default what made the layout.

    Raises
    ------
    FileError
        When the ending is another, or nothing can be written there.
    ParameterError, GeometryError
        As for :func:`solid_page`.
    """
    target = check_page_path(path)
    text = solid_page(thing, solids=solids, name=name)
    with written_whole(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
