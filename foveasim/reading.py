"""Layouts from anywhere: chip files, maps, arrays, settings files, and those that come with the package."""

from __future__ import annotations

from pathlib import Path

from foveasim.layout import Layout

__all__ = ["read_layout"]


def read_layout(path: str | Path, *, layer: int | None = None, cell: str | None = None) -> Layout:
    """
    Read a layout from a file of any format, or by the name of a layout that comes with the package.

    Parameters
    ----------
    path : path or str
        A GDSII, OASIS, GeoJSON, GeoParquet or npz file, recognised by its content; a YAML file of a generator and its
        parameters; or a name, such as ``"giotto_2"``. A file of that name in the working directory comes first, as on
        the command line.
    layer : int, optional
        Of GDSII and OASIS: the layer that contains the photosites; needed where shapes lie on several.
    cell : str, optional
        Of GDSII and OASIS: the cell to read, with all cells below it; needed where there are several top cells.

    Returns
    -------
    Layout
        Without the design rules and the source that a YAML file may state: :func:`foveasim.config.read_any_layout`
        returns these too.

    Raises
    ------
    FileError
        When there is neither such a file nor such a name, or the file is corrupt, truncated, too large, or not a layout.
    ParameterError
        When an option does not belong to the file's format.

    Examples
    --------
    >>> read_layout("prima_100").n_sites
    378
    """
    from foveasim.config import read_any_layout

    return read_any_layout(path, layer=layer, cell=cell).layout
