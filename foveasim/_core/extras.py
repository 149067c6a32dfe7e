"""Optional libraries: the extra that installs each, and the message for a missing one."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from foveasim.errors import FileError

__all__ = ["EXTRA_OF", "import_optional", "install_hint", "needs"]

#: Smallest extra that installs each optional module.
EXTRA_OF = {
    "OpenEXR": "pictures",
    "anywidget": "notebook",
    "astropy": "maps",
    "av": "video",
    "cryptography": "explore",
    "distributed": "explore",
    "gdstk": "layout",
    "h5netcdf": "maps",
    "h5py": "video",
    "imagecodecs": "pictures",
    "klayout": "klayout",
    "lxml": "view",
    "networkx": "view",
    "optuna": "explore",
    "pandas": "maps",
    "pyarrow": "parquet",
    "pyvista": "view",
    "starlette": "studio",
    "torch": "learn",
    "uvicorn": "studio",
    "vtkmodules": "view",
    "websockets": "studio",
    "xarray": "explore",
    "zarr": "video",
}


def install_hint(module: str, extra: str | None = None) -> str:
    """Return the command that installs a module, by default with its smallest extra."""
    return f"install it with: pip install 'foveasim[{extra or EXTRA_OF[module]}]'"


def needs(module: str, extra: str | None = None) -> str:
    """Return the message for a missing module."""
    return f"needs {module}; {install_hint(module, extra)}"


def import_optional(path: Path, module: str) -> Any:
    """
    Import an optional module that a file requires.

    Raises
    ------
    FileError
        When the module is not installed; the message contains the path of the file.
    """
    try:
        return import_module(module)
    except ImportError:
        raise FileError(path, needs(module)) from None
