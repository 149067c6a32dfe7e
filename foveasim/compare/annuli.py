"""Picture quality by eccentricity: PSNR and SSIM in annuli around a fixation point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, Ints, check_number
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.metrics.quality import ssim_map
from foveasim.reconstruct import Picture

__all__ = ["Annuli", "PictureQuality", "quality_by_eccentricity"]


class PictureQuality(NamedTuple):
    """PSNR in dB and SSIM of a picture, in total and by annulus, and its fitted gain."""

    psnr_db: float
    ssim: float
    psnr_db_by_eccentricity: Floats
    ssim_by_eccentricity: Floats
    gain: float

    def __repr__(self) -> str:
        return short_repr(self)


class Annuli(NamedTuple):
    """Annuli around a fixation point, between increasing radii."""

    centre_um: tuple[float, float]
    edges_um: Floats

    def index_of(self, xy_um: Floats) -> Ints:
        """Return the index of the annulus of points (..., 2) µm; -1 outside all of them."""
        r_um = np.hypot(xy_um[..., 0] - self.centre_um[0], xy_um[..., 1] - self.centre_um[1])
        index = np.searchsorted(self.edges_um, r_um, side="right") - 1
        return np.where((index >= 0) & (index < self.edges_um.size - 1), index, -1)

    def means(self, values: Floats, index: Ints, weights: Floats | None = None) -> Floats:
        """
        Return the sum of values per sum of weights in each annulus, by default per point.

        It is NaN for an annulus without points.
        """
        inside, n = index >= 0, self.edges_um.size - 1
        sums = np.bincount(index[inside], values[inside], minlength=n)
        totals = np.bincount(index[inside], None if weights is None else weights[inside], minlength=n)
        return np.divide(sums, totals, out=np.full(n, np.nan), where=totals > 0)


def quality_by_eccentricity(
    picture: Picture,
    reference: Picture,
    *,
    edges_um: Floats,
    centre_um: tuple[float, float] = (0.0, 0.0),
    is_compared: Bools | None = None,
    data_range: float | None = None,
) -> PictureQuality:
    """
    Compute PSNR and SSIM in annuli, after a fit of one gain.

    Parameters
    ----------
    picture, reference : Picture
        Of the same grid and channels.
    edges_um : (n_annulus + 1,) float64, µm
        Increasing radii of the annuli.
    centre_um : (x, y), µm
        Fixation point.
    is_compared : (n_y, n_x) bool, optional
        Compared pixels; by default those where both have a value and a coverage of at least one half.
    data_range : float, optional
        Peak value for both measures; by default the range of the reference over the compared pixels.

    Returns
    -------
    PictureQuality
        NaN in annuli without compared pixels.

    Raises
    ------
    ParameterError
        When the grids or channels differ, or no pixel can be compared.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> grid, layout = (
    ...     fs.Grid.centred((32, 32), 2.0),
    ...     fs.layout.grid(n_x=16, n_y=16, pitch_um=4.0),
    ... )
    >>> irradiance = 1.0 + 0.2 * np.sin(0.3 * np.arange(32.0)) * np.ones((32, 1))  # W/m²
    >>> reference = fs.reconstruct.reference(
    ...     fs.PowerMap.from_array(irradiance, pitch_um=2.0, wavelength_nm=550.0), grid
    ... )
    >>> picture = fs.reconstruct.linear(
    ...     layout, fs.Integrator(layout, grid)(irradiance), grid
    ... )
    >>> quality = fs.compare.quality_by_eccentricity(
    ...     picture, reference, edges_um=np.array([0.0, 16.0, 32.0])
    ... )
    >>> (
    ...     quality.psnr_db_by_eccentricity.round(1).tolist(),
    ...     round(float(quality.gain), 3),
    ... )  # gain of 1/16: sites have 16 µm²
    ([36.1, 34.1], 0.063)
    """
    if picture.grid != reference.grid:
        raise ParameterError(
            "reference",
            f"must have the same grid as the picture, {_describe(picture.grid)}, got {_describe(reference.grid)}; "
            "pass the same grid= to both",
        )
    if picture.data.shape != reference.data.shape:
        raise ParameterError(
            "reference", f"must have the same {picture.data.shape[0]} channels as the picture", reference.data.shape[0]
        )
    one, other = (np.asarray(p.data, np.float64) for p in (picture, reference))
    known = np.isfinite(one).all(axis=0) & np.isfinite(other).all(axis=0)
    if is_compared is None:
        is_compared = np.minimum(picture.coverage, reference.coverage) >= 0.5
    compared = known & is_compared
    if not compared.any():
        raise ParameterError("picture", "must have at least one pixel in common with the reference")
    if data_range is None:
        data_range = float(np.ptp(other[:, compared]))
    data_range = check_number("data_range", data_range, above=0.0)
    power = float(np.square(one[:, compared]).sum())
    gain = float((one[:, compared] * other[:, compared]).sum()) / power if power > 0.0 else 1.0
    error = np.where(compared, np.square(gain * one - other).mean(axis=0), 0.0)
    similarity, fits = ssim_map(
        np.where(compared, gain * one, 0.0), np.where(compared, other, 0.0), compared, data_range
    )
    grid = picture.grid
    centres_um = np.stack(np.meshgrid(grid.x_um, grid.y_um), axis=-1)
    annuli = Annuli(centre_um, np.asarray(edges_um, np.float64))
    annulus = annuli.index_of(centres_um)
    return PictureQuality(
        psnr_db=float(_psnr_db(np.asarray(error[compared].mean()), data_range)),
        ssim=float(similarity[fits].mean()) if fits.any() else float("nan"),
        psnr_db_by_eccentricity=_psnr_db(annuli.means(error, np.where(compared, annulus, -1)), data_range),
        ssim_by_eccentricity=annuli.means(similarity, np.where(fits, annulus, -1)),
        gain=gain,
    )


def _psnr_db(mean_square: NDArray[np.float64], data_range: float) -> Floats:
    with np.errstate(divide="ignore"):
        return np.asarray(10.0 * np.log10(data_range**2 / mean_square))


def _describe(grid: Grid) -> str:
    n_y, n_x = grid.shape
    x_um, y_um = grid.origin_um
    return f"{n_x} x {n_y} pixels of {grid.pitch_x_um:.4g} µm from ({x_um:.4g}, {y_um:.4g}) µm"
