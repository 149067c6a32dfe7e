"""
Checks of extensions: properties of all registered objects of a kind.

:func:`check_extension` raises an AssertionError that names the object, the violated property and the cause. The checks use the
example of the object, ``registry.register(name, example=..., expected=...)``:

================  =============================================================  =========================================
kind              example                                                        expected
================  =============================================================  =========================================
layout generator     parameters of a small layout
layout edit       parameters for a grid of 4 x 4 squares of 10 µm
design rule       limits ``satisfied`` and ``violated`` by this grid; further
                  parameters of DesignRules; a function ``layout`` of another
                  layout
layout format     function of a path that writes a small file and returns its
                  layout; by default the format writes the file
derived layer     parameters for the grid                                        area of the union, µm²
power map format  as layout formats, for power maps
cube format       as layout formats; returns the radiance (n_band, n_y, n_x) of
                  the scene, bottom row first, W/(m² sr nm)
effect            parameters
pixel optics      parameters                                                     response of a square of 10 µm on the
                                                                                 axis at f/2.8
curve             parameters                                                     mapping of wavelengths, nm, to values
scene             parameters                                                     picture of cells, top row first: ``#``
                                                                                 for bright, ``.`` for dark, else a space
display           parameters                                                     chromaticities of the primaries
pupil             parameters                                                     transmitted fraction of the power
PSF format        as layout formats; returns a PSFGrid
lens model        parameters                                                     mapping of ideal to real points, µm
metric            parameters after the capture
column            none
================  =============================================================  =========================================

Instead of parameters, the example can be a function of an empty directory that writes files and returns the parameters. A
function of a file format may return a pair, with further keywords of the reader.

Examples
--------
>>> from foveasim.testing import check_extension
>>> check_extension("pupil", "annulus")
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from foveasim._core.calls import publish
from foveasim._core.names import possible_names
from foveasim._io.formats import one_line
from foveasim.errors import ParameterError
from foveasim.testing._displays import check_display
from foveasim.testing._effects import check_effect, check_sensor_effect
from foveasim.testing._extension import Check, Extension
from foveasim.testing._files import check_cube_format, check_layout_format, check_map_format, check_psf_format
from foveasim.testing._layouts import check_derived_layer, check_edit, check_generator, check_rule
from foveasim.testing._lenses import check_curve, check_lens, check_pupil
from foveasim.testing._metrics import check_column, check_metric
from foveasim.testing._pixel_optics import check_pixel_optics
from foveasim.testing._scenes import check_scene

__all__ = ["check_all", "check_extension", "check_sensor_effect", "extensions"]

#: Longest quotation of another error in a message, in characters.
MAX_QUOTED = 300
#: Registry and check of each kind.
CHECKS: dict[str, Check] = {
    check.registry.kind: check
    for check in (
        check_generator, check_edit, check_rule, check_layout_format, check_derived_layer, check_map_format, check_effect,
        check_pixel_optics,
        check_curve, check_cube_format, check_scene, check_display, check_pupil, check_psf_format, check_lens, check_metric,
        check_column,
    )
}  # fmt: skip


def extensions(kind: str | None = None) -> Iterator[tuple[str, str]]:
    """
    Iterate over kind and name of all registered objects, or of those of one kind.

    Raises
    ------
    ParameterError
        When the kind is unknown.

    Examples
    --------
    >>> from foveasim.testing import extensions
    >>> ("lens model", "fisheye") in extensions()
    True
    """
    for found in CHECKS if kind is None else (kind,):
        yield from ((found, name) for name in _check_of(found).registry)


def check_extension(kind: str, name: str) -> None:
    """
    Check a registered object by its example.

    Parameters
    ----------
    kind : str
        Kind of its registry, such as ``"effect"`` or ``"layout generator"``.
    name : str

    Raises
    ------
    AssertionError
        When the object does not have a property of its kind.
    ParameterError
        When the kind or the name is unknown.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.testing.check_extension(
    ...     "layout generator", "hexagonal"
    ... )  # AssertionError for a violated property
    """
    check = _check_of(kind)
    item, example = check.registry.find("name", name), check.registry.example(name)
    with TemporaryDirectory() as directory:
        extension = Extension(kind, name, item, example, check.registry.expected(name), Path(directory))
        try:
            check(extension)
        except AssertionError as error:
            raise AssertionError(f"{kind} '{name}' {error}") from error.__cause__
        except Exception as error:
            reason = one_line(str(error), MAX_QUOTED)
            raise AssertionError(f"{kind} '{name}' raises {type(error).__name__}: {reason}") from error


def check_all(kind: str | None = None) -> None:
    """
    Check all registered objects, or those of one kind.

    Raises
    ------
    AssertionError
        When objects do not have a property of their kind; the message lists all of them.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.testing.check_all("effect")  # doctest: +SKIP
    """
    failed = []
    for found, name in extensions(kind):
        try:
            check_extension(found, name)
        except AssertionError as error:
            failed.append(str(error))
    if failed:
        raise AssertionError("\n".join(failed))


def _check_of(kind: str) -> Check:
    if kind not in CHECKS:
        raise ParameterError("kind", "must be a kind of extension", kind, hint=possible_names(kind, list(CHECKS)))
    return CHECKS[kind]


publish(__name__)
