"""Optional libraries: the extra that installs each, and the message for a missing one."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from foveasim.errors import FileError, ParameterError

#: Smallest extra that installs each optional module.
EXTRA_OF = {
    module: extra
    for extra, modules in {
        "adapters": ("deepinv", "torchvision"),
        "events": ("aedat",),
        "explore": (
            "cloudpickle",
            "cryptography",
            "dask",
            "distributed",
            "numcodecs",
            "optuna",
            "sqlalchemy",
            "xarray",
        ),
        "dxf": ("ezdxf",),
        "klayout": ("klayout",),
        "layout": ("gdstk",),
        "learn": ("torch",),
        "maps": ("astropy", "h5netcdf", "pandas"),
        "notebook": ("anywidget", "traitlets"),
        "parquet": ("pyarrow",),
        "pictures": ("OpenEXR", "imagecodecs", "pillow_heif", "rawpy"),
        "studio": ("starlette", "uvicorn", "websockets"),
        "video": ("av", "h5py", "zarr"),
        "view": ("lxml", "networkx", "pyvista", "vtkmodules"),
    }.items()
    for module in modules
}


def needs(module: str, extra: str | None = None) -> str:
    """Return the message for a missing module, by default with its smallest extra."""
    return f"needs {module}; install it with: pip install 'foveasim[{extra or EXTRA_OF[module]}]'"


def import_optional(subject: Path | str, module: str, extra: str | None = None) -> Any:
    """
    Import an optional module, or raise an error with the command that installs it.

    Other imports of optional modules are of those that this function has imported before.

    ``subject``: what requires the module, for the message: the path of a file (FileError), or the name of a function or an
    argument (ParameterError). ``module``: such as ``"astropy.io.fits"``. ``extra``: extra that installs everything that the
    subject requires; by default the smallest one with the module.
    """
    name = module.partition(".")[0]
    try:
        import_module(name)
        return import_module(module)
    except ImportError as error:
        detail = needs(name, extra)
        if not isinstance(error, ModuleNotFoundError):  # installed, but for example without a library of the system
            detail = f"needs {name}, which cannot be imported ({' '.join(str(error).split()):.160})"
    raise FileError(subject, detail) if isinstance(subject, Path) else ParameterError(subject, detail)
