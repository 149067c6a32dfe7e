"""Bundled layouts: names and files."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from foveasim.errors import FileError

__all__ = ["bundled_layouts", "layout_path"]


def bundled_layouts() -> dict[str, Path]:
    """Return the files of the bundled layouts by name: real sensors and those of the paper."""
    package = Path(__file__).parents[2]
    # They are inside an installed package, and next to the package in a repository checkout.
    directory = next(root / "layouts" for root in (package, package.parent) if (root / "layouts").is_dir())
    return {path.stem: path for path in sorted(directory.glob("*.yaml"))}


def layout_path(name: str | Path, directory: str | Path = ".") -> Path:
    """
    Return the file of a layout, from its path or from the name of a bundled layout.

    Parameters
    ----------
    name : path or str
        A file in the directory takes precedence over a bundled layout of the same name.
    directory : path
        Directory of relative paths; the working directory by default.

    Raises
    ------
    FileError
        When a name without extension is neither; the message contains the closest name and all names.
    """
    file = Path(directory) / name
    bundled = bundled_layouts()
    if file.is_file() or Path(name).name != str(name):
        return file
    if str(name) in bundled:
        return bundled[str(name)]
    closest = get_close_matches(Path(name).stem, bundled, n=1)
    if Path(name).suffix or file.exists():
        if closest and not file.exists():
            raise FileError(file, f"no such file; '{closest[0]}' is a bundled layout")
        return file
    suggestion = f"did you mean '{closest[0]}'? " if closest else ""
    raise FileError(
        file, f"no such file, and not the name of a bundled layout; {suggestion}the names are {', '.join(bundled)}"
    )
