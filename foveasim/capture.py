"""The capture: what one exposure gave, with everything needed to tell how it was made."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim.arrays import Floats, Ints, check_choice, check_count, read_only
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Grid
from foveasim.files import written_whole
from foveasim.layout import Layout
from foveasim.reconstruct import Picture, cells, fill_channels, raster_grid
from foveasim.records import described

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pyvista import PolyData  # noqa: TID251 -- a type alone

__all__ = ["Capture"]

FILE_FORMAT = "foveasim capture"
FILE_VERSION = 1
#: Arrays of a capture file, and how a column of the layout is named among them.
ARRAYS = ("code", "electrons", "expected_e", "filter_of_site", "xy_um", "ring_offsets", "site_offsets")
COLUMN_PREFIX = "column_"
#: A file that would unpack to more than this is refused.
MAX_UNPACKED_BYTES = 8 * 2**30


@dataclass(frozen=True, eq=False)
class Capture:
    """
    What one exposure gave.

    Attributes
    ----------
    layout : Layout
        The photosites.
    code : (n_site,) uint8 or uint16, DN
        Digital values.
    electrons : (n_site,) int64, e-
        Charge collected, shot noise and full well included.
    expected_e : (n_site,) float64, e-
        Its expectation, without a draw.
    filter_of_site : (n_site,) int64
        Index of each site's colour filter.
    filter_names : tuple of str
    bits : int
        Of the codes: the highest is ``2**bits - 1``.
    white_dn : (n_filter,) float64, DN
        Code, up to a common factor, of a white scene: equal light in every band of the scene. For white balance.
    settings : mapping
        Plain data: optics, sensor, layout, scene, exposure, seed, frame, versions.
    stage_s : mapping of str to float
        Seconds that each stage took; not part of what is saved.
    """

    layout: Layout
    code: NDArray[Any]
    electrons: Ints
    expected_e: Floats
    filter_of_site: Ints
    filter_names: tuple[str, ...]
    bits: int
    white_dn: Floats
    settings: Mapping[str, Any]
    stage_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n_filters = len(self.filter_names)
        highest = 2 ** check_count("bits", self.bits, at_least=1, at_most=16) - 1
        for name, shape, kinds, limit in (
            ("code", (self.layout.n_sites,), "u", highest),
            ("electrons", (self.layout.n_sites,), "i", None),
            ("expected_e", (self.layout.n_sites,), "f", None),
            ("filter_of_site", (self.layout.n_sites,), "i", n_filters - 1),
            ("white_dn", (n_filters,), "f", None),
        ):
            values = np.asarray(getattr(self, name))
            if values.shape != shape or values.dtype.kind not in kinds:
                raise ParameterError(
                    name, f"must be numbers of the shape {shape}, got {values.dtype} of {values.shape}"
                )
            if values.size and not (np.isfinite(values).all() and values.min() >= 0):
                raise ParameterError(name, "must be finite and >= 0 everywhere")
            if limit is not None and values.size and values.max() > limit:
                raise ParameterError(name, f"must be <= {limit} everywhere", int(values.max()))
            object.__setattr__(self, name, read_only(values.view()))

    def __repr__(self) -> str:
        return f"Capture({self.layout.n_sites} sites, {self.bits} bits, {100 * self.saturated_share:.1f} % saturated)"

    @property
    def saturated_share(self) -> float:
        """Share of the sites that gave the highest code."""
        return float(np.mean(self.code == 2**self.bits - 1)) if self.code.size else 0.0

    def picture(
        self,
        method: Literal["cells"] = "cells",
        *,
        max_pixels: int = 1024,
        grid: Grid | None = None,
        of: Literal["code", "electrons", "expected_e"] = "code",
    ) -> Picture:
        """
        Raster picture of what the sensor saw.

        Parameters
        ----------
        method : {"cells"}
            ``"cells"``: every pixel takes the value of its photosites, weighted by area. On a colour mosaic a site's
            other colours come from the nearest sites that see them.
        max_pixels : int
            Length of the longer side, when no grid is given.
        grid : Grid, optional
            The pixels; by default square ones over the whole layout.
        of : {"code", "electrons", "expected_e"}
            Which values to show.

        Returns
        -------
        Picture
            One channel a colour filter; NaN where no photosite is.

        Raises
        ------
        ParameterError
            When a choice is none of the above.
        """
        check_choice("method", method, ("cells",))
        check_choice("of", of, ("code", "electrons", "expected_e"))
        values = np.asarray(getattr(self, of), dtype=np.float64)
        n_filters = len(self.filter_names)
        if n_filters > 1:
            values = fill_channels(self.layout, values, self.filter_of_site, n_filters)
            values = np.where(np.isnan(values), 0.0, values)
        return cells(self.layout, values, raster_grid(self.layout, max_pixels) if grid is None else grid)

    def to_pyvista(self) -> PolyData:
        """The sites as PolyData with what they measured, for PyVista; see :func:`foveasim.view.polydata`."""
        from foveasim.view import polydata

        return polydata(self)

    def plot(self, by: str | ArrayLike = "code", **options: Any) -> Axes:
        """Draw the photosites on matplotlib axes, coloured by what they measured; see :func:`foveasim.view.plot_capture`."""
        from foveasim.view import plot_capture

        return plot_capture(self, by, **options)

    def save(self, path: str | Path) -> None:
        """
        Write the capture to a ``.npz`` file, whole or not at all.

        Raises
        ------
        FileError
            When the ending is not ``.npz``, or nothing can be written there.
        """
        target = Path(path)
        if target.suffix != ".npz":
            raise FileError(target, "must end in .npz")
        about = {
            "format": FILE_FORMAT,
            "version": FILE_VERSION,
            "filter_names": list(self.filter_names),
            "bits": self.bits,
            "white_dn": self.white_dn.tolist(),
            "settings": self.settings,
            "provenance": described(dict(self.layout.provenance)),
        }
        arrays = {name: getattr(self if hasattr(self, name) else self.layout, name) for name in ARRAYS}
        arrays |= {COLUMN_PREFIX + name: values for name, values in self.layout.columns.items()}
        with written_whole(target) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Capture:
        """
        Read a capture that :meth:`save` wrote.

        Raises
        ------
        FileError
            When the file is missing, broken, too large, or no capture.
        """
        source = Path(path)
        if not source.is_file():
            raise FileError(source, "is not a file" if source.exists() else "no such file")
        try:
            with zipfile.ZipFile(source) as archive:
                if sum(item.file_size for item in archive.infolist()) > MAX_UNPACKED_BYTES:
                    raise FileError(source, f"would unpack to more than {MAX_UNPACKED_BYTES} bytes")
            with np.load(source, allow_pickle=False) as data:
                about = json.loads(str(data["about"]))
                if about.get("format") != FILE_FORMAT:
                    raise FileError(source, "is no foveasim capture")
                if about.get("version") != FILE_VERSION:
                    raise FileError(source, f"has the format version {about.get('version')}, expected {FILE_VERSION}")
                arrays = {name: data[name] for name in ARRAYS}
                columns = {
                    name.removeprefix(COLUMN_PREFIX): data[name]
                    for name in data.files
                    if name.startswith(COLUMN_PREFIX)
                }
            layout = Layout(
                arrays["xy_um"], arrays["ring_offsets"], arrays["site_offsets"], columns, about["provenance"]
            )
            return cls(
                layout=layout,
                code=arrays["code"],
                electrons=arrays["electrons"],
                expected_e=arrays["expected_e"],
                filter_of_site=arrays["filter_of_site"],
                filter_names=tuple(about["filter_names"]),
                bits=int(about["bits"]),
                white_dn=np.asarray(about["white_dn"], dtype=np.float64),
                settings=about["settings"],
            )
        except FileError:
            raise
        except Exception as error:  # noqa: BLE001 -- a broken file makes its readers trip over anything
            told = " ".join(str(error).split())
            raise FileError(source, f"is broken or no foveasim capture ({told})") from None
