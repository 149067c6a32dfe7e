"""Bundled layouts: names and files."""

from __future__ import annotations

from pathlib import Path

from foveasim._core.names import closest_name, missing_path, possible_names
from foveasim.errors import FileError


def bundled_layouts() -> dict[str, Path]:
    """
    Return the files of the bundled layouts by name: real sensors and those of the paper.

    Examples
    --------
    >>> import foveasim as fs
    >>> sorted(fs.layout.bundled_layouts())[:3]
    ['bayer_grid', 'four_zones', 'foveal_blind_spot']
    """
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
    if file.exists():
        return file
    if Path(name).suffix:
        problem = missing_path(file)
        closest = closest_name(Path(name).stem, bundled)
        if closest is not None and "did you mean" not in problem:
            problem += f"; '{closest}' is a bundled layout"
        raise FileError(file, problem)
    hint = possible_names(name, list(bundled))
    raise FileError(file, f"no such file, and not the name of a bundled layout; {hint}")
