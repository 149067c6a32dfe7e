"""Registry of PSF formats, reading and writing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from foveasim._core.calls import POSITIVE, publish
from foveasim._core.names import did_you_mean
from foveasim._core.registry import Registry
from foveasim._core.validation import check_number
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, FormatError, as_file_error, detect_format, select_writer, validate_options
from foveasim.errors import FileError
from foveasim.optics.psfs._grid import PSFGrid

__all__ = ["PSF_FORMATS", "read_psfs"]

#: Formats of PSFs. ``read(path)`` returns a :class:`PSFGrid`, ``write(psfs, path)`` None. Installed packages add formats as
#: entry points of the group ``foveasim.psf_formats``.
PSF_FORMATS: Registry[FileFormat] = Registry("PSF format", "foveasim.psf_formats")
#: Conventions of the frame and the values, in files.
Image = Literal["upright", "inverted"]
FirstRow = Literal["lowest", "highest"]
Samples = Literal["points", "bins"]
CHOICES: dict[str, tuple[str, ...]] = {
    "image": get_args(Image),
    "first_row": get_args(FirstRow),
    "samples": get_args(Samples),
}


def read_psfs(
    path: str | Path,
    *,
    name: str | None = None,
    wavelength_nm: float | Sequence[float] | None = None,
    focal_length_mm: Annotated[float | None, POSITIVE] = None,
    centre: tuple[float, float] | Literal["fft", "middle"] | None = None,
    allow_outside: bool = False,
) -> PSFGrid:
    """
    Read point spread functions from a file.

    Parameters
    ----------
    path : path
        An ``.npz`` or FITS stack, FITS images of POPPY, STPSF and other programs, a text export of Zemax OpticStudio, or a YAML
        index of such exports: see the guide of the optics.
    name : str, optional
        Name or number of the image in a FITS file of several: ``"OVERSAMP"``. By default all, if their wavelengths differ.
    wavelength_nm : float or sequence, optional, nm
        Wavelengths of FITS images without them, and the wavelength for which a PSF of a range stands.
    focal_length_mm : float, optional, mm
        Focal length that converts samples in angles, as in FITS files of telescopes, to lengths.
    centre : (row, column) or {"fft", "middle"}, optional
        As for :meth:`PSFGrid.from_arrays`; by default that of the file. The middle for FITS images without coordinates.
    allow_outside : bool
        Whether an index may name files outside its directory. Settings files never allow it.

    Returns
    -------
    PSFGrid

    Raises
    ------
    FileError
        When a file is missing, outside the directory of its index, too large, of another format, or not consistent, or has
        a keyword or a line that changes the PSF and is not known.
    ParameterError
        When an argument is not one of the format of the file.

    Examples
    --------
    >>> import foveasim as fs
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=8.0)
    >>> h = lens.psf(550.0, pitch_um=2.0, n_points=65).psf_per_um2
    >>> psfs = fs.optics.PSFGrid.from_arrays(
    ...     h, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=2.0
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     psfs.write(Path(folder) / "lens.npz")
    ...     fs.optics.read_psfs(Path(folder) / "lens.npz")
    PSFGrid(1 point, 550 nm, 65 x 65 samples of 2 µm)
    """
    source = Path(path)
    _, form = detect_format(source, PSF_FORMATS, "file of PSFs")
    assert form.read is not None
    options = {"name": name, "wavelength_nm": wavelength_nm, "focal_length_mm": focal_length_mm, "centre": centre}
    given = validate_options(options, form.read_options, PSF_FORMATS, "read_options")
    if focal_length_mm is not None:
        check_number("focal_length_mm", focal_length_mm, above=0.0)
    if allow_outside and "allow_outside" in form.read_options:
        given["allow_outside"] = True
    with as_file_error(source, "file of PSFs", passes=(FileError,)):
        found = form.read(source, **given)
        if not isinstance(found, PSFGrid):
            raise FormatError(f"must be read as a PSFGrid, got {type(found).__name__}")
        return found


def write(psfs: PSFGrid, path: Path) -> None:
    """Write PSFs in the format of a file's extension, atomically."""
    form = select_writer(path, PSF_FORMATS)
    assert form.write is not None
    with atomic_write(path) as temporary:
        form.write(psfs, temporary)


def choices_of(given: dict[str, Any]) -> dict[str, Any]:
    """Return the conventions among the values of a file; raise a FormatError for unknown ones."""
    found = {name: str(given[name]) for name in CHOICES if given.get(name) is not None}
    for name, value in found.items():
        if value not in CHOICES[name]:
            every = " or ".join(map(repr, CHOICES[name]))
            hint = did_you_mean(value, CHOICES[name])
            raise FormatError(f"must have {every} as '{name}', got {value!r:.40}{'; ' * bool(hint)}{hint}")
    return found


def require(given: Any, names: tuple[str, ...]) -> None:
    """Raise a FormatError that names the first missing value of a file."""
    for name in names:
        if name not in given:
            raise FormatError(f"has no '{name}', which files of PSFs must contain")


publish(__name__)
