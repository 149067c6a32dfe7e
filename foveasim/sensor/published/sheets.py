"""
Published data sheets: values as they are printed, with their sources.

Keys are parameters of :class:`foveasim.sensor.DataSheet`, numbers with their printed digits; values that a source does not
print are missing. Third parties have transcribed most of them; the documents are those that they name. Dark currents per hour
are in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

__all__ = ["GROUPS", "SHEETS"]

_ALVIUM = "Allied Vision, data sheet of Alvium 1800 {}, in sensors.py of github.com/markvilar/brov-av-imaging-payload (6d15bec)"
_FRAMOS = (
    "FRAMOS, EMVA 1288 data sheets of IMX900-AMR-C, {}, in ptc_analysis.py of "
    "github.com/brycewilson27/PhotonTransferCurve (2f8bce2)"
)
_MORAVIAN = "Moravian Instruments, C1+ Series User Manual, p. 15, 12 bits, 0 dB"


def _alvium(name: str, sensor: str, pixel_um: str, **values: Any) -> dict[str, Any]:
    """Return the sheet of a monochrome camera of one series."""
    common = {"title": f"Allied Vision Alvium 1800 {name} ({sensor})", "source": _ALVIUM.format(name)}
    return {**common, "pixel_um": pixel_um, "bits": 12, "wavelength_nm": 529, "shutter": "global", **values}


#: Sheets by the names of their presets.
SHEETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "mobile": {
            "title": "OmniVision OV5647, mobile camera",
            "source": "OptArc, AF51 user guide, v1.02, p. 21; the dynamic range is taken as full well over noise",
            "pixel_um": "1.4",
            "bits": 10,
            "full_well_e": 4300,
            "noise_dynamic_range_db": 68,
        },
        "machine_vision": {
            "title": "Sony IMX250 in the Genie Nano M2450, global shutter",
            "source": "Teledyne DALSA, Genie Nano manual, p. 42; the dynamic range is taken as full well over noise",
            "pixel_um": "3.45",
            "bits": 12,
            "full_well_e": 10_700,
            "noise_dynamic_range_db": "75.46",
        },
        "scientific": {
            "title": "Andor Zyla 5.5, scientific CMOS",
            "source": "Andor, Zyla hardware manual, version 2.0 rev. 18, 2021, pp. 22 and 25: 16 bits, 560 MHz",
            "pixel_um": "6.5",
            "bits": 16,
            "inverse_gain_e_per_dn": "0.45",
            "dark_noise_e": "1.38",
            "full_well_e": 30_000,
        },
        "imx900_low_gain": {
            "title": "Sony IMX900, low conversion gain",
            "source": _FRAMOS.format("low gain, 0 dB"),
            "pixel_um": "2.25",
            "bits": 12,
            "wavelength_nm": 536,
            "qe_percent": "91.25",
            "gain_dn_per_e": "0.399",
            "inverse_gain_e_per_dn": "2.505",
            "dark_noise_e": "5.560",
            "dark_noise_dn": "2.238",
            "threshold_ph": "6.692",
            "threshold_e": "6.106",
            "saturation_ph": 10365,
            "saturation_e": 9458,
            "dynamic_range_db": "63.8",
            "snr_max_db": "39.76",
            "dsnu_e": "3.7",
            "dsnu_dn": "1.5",
            "prnu_percent": "0.7",
            "linearity_error_min_percent": "-1.133",
            "linearity_error_max_percent": "0.595",
            "black_level_dn": 240,
            "shutter": "global",
        },
        "imx900_high_gain": {
            "title": "Sony IMX900, high conversion gain",
            "source": _FRAMOS.format("high gain, 3 dB"),
            "pixel_um": "2.25",
            "bits": 12,
            "wavelength_nm": 536,
            "qe_percent": "88.47",
            "gain_dn_per_e": "1.673",
            "inverse_gain_e_per_dn": "0.598",
            "dark_noise_e": "1.954",
            "dark_noise_dn": "3.281",
            "threshold_ph": "2.782",
            "threshold_e": "2.461",
            "saturation_ph": 2468,
            "saturation_e": 2183,
            "dynamic_range_db": "59.0",
            "snr_max_db": "33.39",
            "dsnu_e": "1.3",
            "dsnu_dn": "2.1",
            "prnu_percent": "0.8",
            "linearity_error_min_percent": "-0.550",
            "linearity_error_max_percent": "0.294",
            "dark_current_e_per_s": "1.473",
            "temperature_k": 309,
            "black_level_dn": 240,
            "shutter": "global",
        },
        "imx250": {
            "title": "FLIR Blackfly S BFS-U3-51S5M-C (Sony IMX250)",
            "source": "FLIR, EMVA 1288 page of BFS-U3-51S5, firmware 1801.0.1.0, 2022-11-18, in a public comparison table",
            "pixel_um": "3.45",
            "bits": 16,
            "wavelength_nm": 525,
            "qe_percent": "63.40",
            "dark_noise_e": "2.44",
            "saturation_e": "10970",
            "snr_max_db": "40.40",
            "dynamic_range_db": "71.45",
            "temperature_k": 293,
        },
        "imx174": {
            "title": "Basler acA1920-155um (Sony IMX174)",
            "source": (
                "Basler, EMVA 1288 report of acA1920-155um, in two public repositories, without its threshold of about 10 "
                "photons, which is 11 for its noise; the pixel is that of the Basler EMVA 1288 data overview"
            ),
            "pixel_um": "5.86",
            "bits": 12,
            "wavelength_nm": 545,
            "qe_percent": 70,
            "inverse_gain_e_per_dn": "8.4",
            "dark_noise_e": "6.8",
            "saturation_e": 32_700,
            "snr_max_db": "45.1",
            "dsnu_e": "1.9",
            "prnu_percent": "0.5",
        },
        "imx264": _alvium(
            "C-507m", "Sony IMX264", "3.45", qe_percent=64, dark_noise_e="2.1", threshold_e="2.7", saturation_e=10_400,
            dynamic_range_db=72, frames_per_s=34,
        ),
        "imx273": _alvium(
            "C-158m", "Sony IMX273", "3.45", qe_percent=64, dark_noise_e="2.1", threshold_e="2.7", saturation_e=10_400,
            dynamic_range_db=72,
        ),
        "imx287": _alvium(
            "C-040m", "Sony IMX287", "6.9", qe_percent=64, dark_noise_e="3.2", threshold_e="4.0", dynamic_range_db=74
        )
        | {"source": _ALVIUM.format("C-040m") + "; without its saturation of 208,000 e-, 20 dB above its dynamic range"},
        "imx421": _alvium(
            "C-291m", "Sony IMX421", "4.5", qe_percent=73, dark_noise_e="5.4", threshold_e="6.2", saturation_e=25_000,
            dynamic_range_db=72,
        ),
        "imx426": _alvium(
            "C-052m", "Sony IMX426", "9.0", qe_percent=73, dark_noise_e="21.8", threshold_e="23.7", saturation_e=100_000,
            dynamic_range_db=73,
        ),
        "imx547": _alvium(
            "C-511m", "Sony IMX547", "2.74", qe_percent=68, dark_noise_e="2.3", threshold_e="2.9", saturation_e=9_400,
            dynamic_range_db=70,
        ),
        "imx990": {
            "title": "LUCID Atlas SWIR 1.3 MP (Sony IMX990)",
            "source": (
                "LUCID, EMVA 1288 data of Atlas SWIR 1.3 MP at 0 dB, thinklucid.com, in a public list of presets; its quantum "
                "efficiency above 75 % at 1,200 nm is a limit"
            ),
            "pixel_um": 5,
            "bits": 12,
            "dark_noise_e": 196,
            "saturation_e": 143_000,
            "dark_current_e_per_s": 4000,
            "temperature_k": "288.15",
            "shutter": "global",
        },
        "phantom_c211": {
            "title": "Vision Research Phantom Miro C211, high speed",
            "source": (
                "Vision Research, miroc211_emva1288-report.pdf, standard mode, in github.com/GolubchikD/CameraSim; its "
                "dynamic range is saturation over noise; without its maximum SNR of 38.7 dB, the root of 7,413 e-"
            ),
            "pixel_um": "5.6",
            "bits": 12,
            "wavelength_nm": 532,
            "qe_percent": "41.7",
            "dark_noise_e": "9.08",
            "saturation_e": 6972,
            "noise_dynamic_range_db": "57.7",
            "frames_per_s": 1800,
        },
        "imx455": {
            "title": "QHY600M Pro (Sony IMX455), mode 1, gain 0",
            "source": "Alarcon et al., PASP 135, 055001 (2023), arXiv:2302.03700, tables 1 to 3",
            "pixel_um": "3.76",
            "bits": 16,
            "wavelength_nm": 475,
            "qe_percent": 80,
            "inverse_gain_e_per_dn": "0.763",
            "dark_noise_e": "3.5",
            "saturation_e": 50_000,
            "dark_current_e_per_s": "0.011",
            "temperature_k": 263,
        },
        "c1plus_345": {
            "title": "Moravian C1+ with pixels of 3.45 µm",
            "source": _MORAVIAN,
            "pixel_um": "3.45",
            "bits": 12,
            "inverse_gain_e_per_dn": "2.8",
            "dark_noise_e": "2.2",
            "full_well_e": 11_000,
        },
        "c1plus_450": {
            "title": "Moravian C1+ with pixels of 4.50 µm",
            "source": _MORAVIAN,
            "pixel_um": "4.50",
            "bits": 12,
            "inverse_gain_e_per_dn": "6.3",
            "dark_noise_e": "5.3",
            "full_well_e": 26_000,
        },
        "kaf_3200me": {
            "title": "QSI 532 (Kodak KAF-3200ME), CCD",
            "source": 'C. Buil, "Parameters of CCD and CMOS cameras", astrosurf.com/buil/cameras',
            "pixel_um": "6.80",
            "bits": 16,
            "wavelength_nm": "656.3",
            "qe_percent": 79,
            "inverse_gain_e_per_dn": "1.413",
            "dark_noise_e": "12.6",
            "saturation_e": 70_000,
            "dark_current_e_per_s": "0.080",
            "temperature_k": 273,
            "shutter": "global",
        },
        "esi_ccd": {
            "title": "MIT Lincoln Laboratory CCD of Keck ESI, low gain",
            "source": "Keck Observatory, ESI CCD page, keck.hawaii.edu/inst/esi/ccd.html; dark current 2 e-/h",
            "pixel_um": 15,
            "bits": 16,
            "inverse_gain_e_per_dn": "1.29",
            "dark_noise_e": "2.7",
            "full_well_e": 105_000,
            "dark_current_e_per_s": "0.00056",
            "temperature_k": 153,
        },
        "ccd273": {
            "title": "Teledyne e2v CCD273-84 in Euclid VIS, limits of its specification",
            "source": "Cropper et al., A&A 697, A2 (2025), arXiv:2405.13492: at least 175,000 e-, at most 4.5 e- at 70 kHz",
            "pixel_um": 12,
            "bits": 16,
            "wavelength_nm": 650,
            "qe_percent": 94,
            "inverse_gain_e_per_dn": "3.5",
            "dark_noise_e": "4.5",
            "full_well_e": 175_000,
            "temperature_k": 153,
        },
    }
)  # fmt: skip

#: Names of sheets by use, in the order of lists.
GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "mobile": ("mobile",),
        "machine vision": (
            "machine_vision", "imx900_low_gain", "imx900_high_gain", "imx174", "imx250", "imx264", "imx273", "imx287", "imx421",
            "imx426", "imx547",
        ),
        "scientific": ("scientific", "phantom_c211", "imx990"),
        "astronomy": ("imx455", "c1plus_345", "c1plus_450", "kaf_3200me", "esi_ccd", "ccd273"),
    }
)  # fmt: skip
