"""Colour correction: from the values of colour filters to linear sRGB."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import null_space

from foveasim._core.validation import Floats
from foveasim.fields import PowerMap
from foveasim.reconstruct import ColourCorrection
from foveasim.scene import Scene
from foveasim.scene._colorimetry import LUMINANCE_WEIGHTS, lab_of, patch_colours, photograph_of_patches, reflectances
from foveasim.sensor import Sensor

#: Channels of linear sRGB.
N_RGB = 3
#: Lower limit of a filter's response, relative to the strongest filter, for white balance.
MIN_WHITE_FRACTION = 0.01
#: Filters whose responses to the patches have smaller singular values, relative to the largest, do not distinguish colours.
MIN_SINGULAR_VALUE = 1e-3
#: Patches are weighted by the slope of CIELAB at their luminance; darker patches than this, relative to white, as at this one.
MIN_LUMINANCE = 0.01
#: Matrices and colour differences are rounded, so that they are equal on all machines.
MATRIX_DECIMALS, DIFFERENCE_DECIMALS = 9, 3


def white_response(sensor: Sensor, light: Scene | PowerMap) -> Floats:
    """Return the responses (n_filter,) to white, above 0, relative to the strongest."""
    spectra, width_nm = _white(light)
    response = sensor.responsivity_e_per_j(light.wavelength_nm) @ (spectra * width_nm)
    max_response = float(response.max(initial=0.0))
    if max_response == 0.0:
        return np.ones(response.size)
    return np.maximum(response / max_response, MIN_WHITE_FRACTION)


def _white(light: Scene | PowerMap) -> tuple[Floats, Floats]:
    """Return the relative spectrum of white, and the widths of the bands."""
    n_bands = light.wavelength_nm.size
    if isinstance(light, PowerMap):
        return np.ones(n_bands), np.ones(n_bands)
    return np.ones(n_bands) if light.illuminant is None else light.illuminant, light.band_width_nm


def colour_correction(sensor: Sensor, light: Scene | PowerMap) -> ColourCorrection | None:
    """
    Return the colour correction of a sensor's filters for a scene.

    For photographs in red, green and blue, the matrix inverts the responses of the filters to the three primaries: noiseless
    values return the photograph. For other scenes it is the least-squares solution for the 24 patches of the colour chart
    under the illuminant of the scene, adapted to D65, with the weights of CIELAB, that preserves white (Finlayson and Drew,
    White-point preserving color correction, 5th Color Imaging Conference, 1997).

    Returns None if the filters cannot distinguish colours: fewer than three filters have photosites, the light has fewer than
    three bands, or the responses of filters are too similar.
    """
    n_filters, waves_nm = len(sensor.filter_names), light.wavelength_nm
    if min(n_filters, waves_nm.size) < N_RGB:
        return None
    white, width_nm = _white(light)
    is_rgb = isinstance(light, Scene) and light.is_rgb
    arrays = (
        (np.bincount(sensor.filter_of_site, minlength=n_filters) > 0).astype(np.float64),
        sensor.responsivity_e_per_j(waves_nm) * width_nm,
        white_response(sensor, light),
        waves_nm,
        width_nm,
        light.spectrum_w_m2_sr_nm if isinstance(light, Scene) and is_rgb else white[np.newaxis],
    )
    # Frames of a video and samples of a dataset have the same light and filters.
    return _correction(*((np.asarray(part, np.float64).tobytes(), part.shape) for part in arrays))


@lru_cache(maxsize=64)
def _correction(*stored: tuple[bytes, tuple[int, ...]]) -> ColourCorrection | None:
    """Return the correction for the arrays of :func:`colour_correction`."""
    has_sites, responsivity, balance, waves_nm, width_nm, white = (
        np.frombuffer(data).reshape(shape) for data, shape in stored
    )
    if white.shape[0] == N_RGB:
        target: Floats | None = photograph_of_patches()
        spectra = photograph_of_patches() @ white
    else:
        target, spectra = patch_colours(white[0], waves_nm, width_nm), reflectances(waves_nm) * white
    if target is None:
        return None
    to_white = responsivity @ white.sum(axis=0)
    scale = balance * (float(to_white.max()) or 1.0)
    values, of_white = ((part / scale) * has_sites for part in (spectra @ responsivity.T, to_white))
    singular = np.linalg.svd(values, compute_uv=False)
    if singular[N_RGB - 1] <= MIN_SINGULAR_VALUE * singular[0]:
        return None
    weight = np.maximum(target @ LUMINANCE_WEIGHTS, MIN_LUMINANCE)[:, np.newaxis] ** (-2.0 / 3.0)
    # matrix = fixed + free, where fixed maps white to white and free maps it to black.
    fixed = np.outer(np.ones(N_RGB), of_white / (of_white @ of_white))
    directions = null_space(of_white[np.newaxis])
    free = np.linalg.lstsq(weight * (values @ directions), weight * (target - values @ fixed.T))[0]
    matrix = np.round(fixed + (directions @ free).T, MATRIX_DECIMALS) * has_sites
    exact = lab_of(target)
    difference = np.linalg.norm(lab_of(values @ matrix.T) - exact, axis=1)
    raw: Floats = np.full(difference.size, np.nan)
    if values.shape[1] == N_RGB:
        raw = np.linalg.norm(lab_of(values) - exact, axis=1)
    return ColourCorrection(matrix, *(np.round(part, DIFFERENCE_DECIMALS) for part in (difference, raw)))
