"""Measured curves of real devices from bundled tables; each data file states its source."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np

from foveasim.sensor.spectral.curves import CURVES
from foveasim.sensor.spectral.files import read_curve, read_filters
from foveasim.sensor.spectral.response import FilterSet
from foveasim.sensor.spectral.tables import SplineCurve, TableCurve

__all__ = ["camera_filters", "ccd_qe"]


@CURVES.register("ccd", expected={440.0: 0.857})
def ccd_qe() -> TableCurve | SplineCurve:
    """
    Read the measured quantum efficiency of a back-illuminated CCD (cf. the paper's Fig. 5).

    Returns
    -------
    TableCurve
        Range 320 to 1100 nm; maximum 0.857 at 440 nm.

    Notes
    -----
    Source: test report of the European Southern Observatory on an OmegaCAM device, EEV 44-82-1-A57 'Centaurus'. Another device
    of this type agrees within 0.045 above 480 nm, and is lower by up to 0.13 below.

    Examples
    --------
    >>> ccd_qe()(600.0)
    array(0.776)
    """
    return read_curve(_data("ccd44_82_qe"))


def camera_filters() -> FilterSet:
    """
    Read the measured RGB sensitivities of a camera (Nikon D5100).

    The sensitivities include infrared-cut filter and quantum efficiency.

    Returns
    -------
    FilterSet
        "R", "G" and "B" from 380 to 780 nm. The data are relative, with a maximum of 1 for each colour; the sensor's ``qe``
        should therefore be a number, the quantum efficiency at the maximum.

    Notes
    -----
    Source: M. M. Darrodi et al., Reference data set for camera spectral sensitivity estimation, J. Opt. Soc. Am. A 32, 381,
    2015. The data are interpreted as response per radiance, and divided by the wavelength to give electrons per photon. J.
    Jiang et al. (WACV 2013) measured the same camera type: the difference is at most 0.11, except at the steep edge at 420 nm.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.sensor.camera_filters().names
    ('R', 'G', 'B')
    """
    measured = read_filters(_data("nikon_d5100_rgb"))
    curves = []
    for curve in measured.curves:
        assert isinstance(curve, TableCurve)
        per_photon = np.asarray(curve.value) / np.asarray(curve.wavelength_nm)
        fractions = (per_photon / per_photon.max()).tolist()
        curves.append(TableCurve(wavelength_nm=curve.wavelength_nm, value=fractions, source=curve.source))
    return FilterSet(curves, measured.names)


def _data(name: str) -> Path:
    return Path(str(files("foveasim.sensor") / "data" / f"{name}.csv"))
