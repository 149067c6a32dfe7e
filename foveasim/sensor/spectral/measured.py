"""Curves of real devices, from tables that come with the package: each data file says where its figures are from."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np

from foveasim.sensor.spectral.curves import CURVES
from foveasim.sensor.spectral.files import read_curve, read_filters
from foveasim.sensor.spectral.response import FilterSet
from foveasim.sensor.spectral.tables import SplineCurve, TableCurve

__all__ = ["camera_filters", "ccd_qe"]


@CURVES.register("ccd")
def ccd_qe() -> TableCurve | SplineCurve:
    """
    Quantum efficiency of a back-illuminated silicon CCD, as measured: a table for the paper's Fig. 5.

    Returns
    -------
    TableCurve
        From 320 to 1100 nm; its highest value is 0.857, at 440 nm.

    Notes
    -----
    The European Southern Observatory's test report of one of OmegaCAM's devices, EEV 44-82-1-A57 'Centaurus'. Another device
    of the type is the same within 0.045 above 480 nm, and lower by up to 0.13 below.

    Examples
    --------
    >>> ccd_qe()(600.0)
    array(0.776)
    """
    return read_curve(_data("ccd44_82_qe"))


def camera_filters() -> FilterSet:
    """
    Red, green and blue of a camera (Nikon D5100) with its infrared cut, as measured: the quantum efficiency is included.

    Returns
    -------
    FilterSet
        "R", "G" and "B" from 380 to 780 nm. The measurement is relative: each colour's highest value is 1, and the sensor's
        ``qe`` is to be the one number that it stands for.

    Notes
    -----
    M. M. Darrodi et al., Reference dataset for camera spectral sensitivity estimation, J. Opt. Soc. Am. A 32, 381, 2015;
    taken as response per radiance, and divided by the wavelength to give electrons per photon. J. Jiang et al. (WACV 2013)
    measured the same type: within 0.11, but for the steep edge at 420 nm.
    """
    measured = read_filters(_data("nikon_d5100_rgb"))
    curves = []
    for curve in measured.curves:
        assert isinstance(curve, TableCurve)
        per_photon = np.asarray(curve.value) / np.asarray(curve.wavelength_nm)
        shares = (per_photon / per_photon.max()).tolist()
        curves.append(TableCurve(wavelength_nm=curve.wavelength_nm, value=shares, source=curve.source))
    return FilterSet(curves, measured.names)


def _data(name: str) -> Path:
    return Path(str(files("foveasim.sensor") / "data" / f"{name}.csv"))
