"""
Commented files to start from, one per kind.

Files include each other, so that each value has one source.
"""

from __future__ import annotations

import re
import shlex
from importlib.resources import files
from pathlib import Path

from foveasim._core.validation import check_choice
from foveasim._io.atomic import atomic_write
from foveasim.errors import FileError

#: Kinds of files.
STARTING_FILES = ("shot", "layout", "rules", "sweep", "study", "dataset")
#: A line that stands for the content of another file.
INCLUDED = re.compile(r"^( *)\{(\w+)\}\n", re.MULTILINE)
#: The line of the initial comment with the command for the file.
COMMAND = re.compile(r"^# +(foveasim .*)$", re.MULTILINE)


def starting_file(kind: str) -> str:
    r"""
    Return the commented YAML of a kind of file, with valid values.

    Parameters
    ----------
    kind : {"shot", "layout", "rules", "sweep", "study", "dataset"}

    Examples
    --------
    >>> import foveasim as fs
    >>> print(*fs.config.starting_file("rules").splitlines()[4:7], sep="\n")
    min_size_um: 4.0                     # µm, square root of the area of a photosite
    min_width_um: 3.0                    # µm, between facing edges of a photosite
    angle_limit_deg: 25.0                # facing edges converge by less; 90 as in KLayout, which rejects annular photosites
    """
    check_choice("kind", kind, STARTING_FILES)
    text = (files("foveasim.config") / "starting_files" / f"{kind}.yaml").read_text(encoding="utf-8")

    def content(line: re.Match[str]) -> str:
        indent = line[1]
        _, _, body = starting_file(line[2]).partition("\n\n")  # without the initial comment
        aligned = re.sub(rf"(^|(?<=\S)){indent}( +#)", r"\2", body, flags=re.MULTILINE)
        return "".join(indent + each for each in aligned.splitlines(keepends=True))

    return INCLUDED.sub(content, text)


def starting_command(kind: str, path: str | Path) -> str:
    """
    Return the command that uses a file of a kind.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.config.starting_command("sweep", "sweep.yaml")
    'foveasim sweep sweep.yaml --out results.zarr'
    """
    found = COMMAND.search(starting_file(kind))
    assert found is not None
    return found[1].replace("FILE", shlex.quote(str(path)))


def write_starting_file(kind: str, path: str | Path | None = None, *, force: bool = False) -> Path:
    """
    Write a commented file of a kind, to start from.

    Parameters
    ----------
    kind : {"shot", "layout", "rules", "sweep", "study", "dataset"}
    path : path, optional
        By default the kind with the extension ``.yaml``, in the working directory.
    force : bool
        Whether to replace an existing file.

    Returns
    -------
    path : Path
        The file, which is written atomically.

    Raises
    ------
    FileError
        When the file exists, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = fs.config.write_starting_file("shot", Path(directory, "shot.yaml"))
    ...     print(fs.config.read_shot(path).camera.optics.focal_length_mm)
    8.0
    """
    text = starting_file(kind)
    path = Path(f"{kind}.yaml" if path is None else path)
    if path.exists() and not force:
        raise FileError(path, "exists already; choose another file with --out, or replace it with --force")
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path
