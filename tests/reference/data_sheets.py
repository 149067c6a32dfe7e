"""
Values of published data sheets in the terms of EMVA 1288, as printed, with their sources.

Third parties have transcribed most of them; the documents are those that they name.
"""

_ALVIUM = "Allied Vision, data sheet of Alvium 1800 {}, in sensors.py of github.com/markvilar/brov-av-imaging-payload (6d15bec)"
_FRAMOS = (
    "FRAMOS, EMVA 1288 data sheets of IMX900-AMR-C, {}, in ptc_analysis.py of "
    "github.com/brycewilson27/PhotonTransferCurve (2f8bce2)"
)

#: Parameters of foveasim.sensor.DataSheet.
SHEETS = {
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
        "black_level_dn": 240,
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
        "dark_current_e_per_s": "1.473",
        "temperature_k": 309,
        "black_level_dn": 240,
    },
    "bfs_u3_51s5m": {
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
    **{
        f"alvium_{name.lower().replace('-', '_')}": {
            "title": f"Allied Vision Alvium 1800 {name} ({sensor})",
            "source": _ALVIUM.format(name),
            "pixel_um": pixel,
            "bits": 12,
            "wavelength_nm": 529,
            "qe_percent": qe,
            "dark_noise_e": noise,
            "threshold_e": threshold,
            "saturation_e": saturation,
            "dynamic_range_db": ratio,
        }
        for name, sensor, pixel, qe, noise, threshold, saturation, ratio in (
            ("C-052m", "Sony IMX426", "9.0", 73, "21.8", "23.7", 100_000, 73),
            ("C-158m", "Sony IMX273", "3.45", 64, "2.1", "2.7", 10_400, 72),
            ("C-291m", "Sony IMX421", "4.5", 73, "5.4", "6.2", 25_000, 72),
            ("C-507m", "Sony IMX264", "3.45", 64, "2.1", "2.7", 10_400, 72),
            ("C-511m", "Sony IMX547", "2.74", 68, "2.3", "2.9", 9_400, 70),
        )
    },
    "qhy600m": {
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
    "qsi_532": {
        "title": "QSI 532 (Kodak KAF-3200ME)",
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
    },
}

#: A sheet with an error of print: 208,000 e- for 20,800, 20 dB above its own dynamic range.
MISPRINTED = {
    "title": "Allied Vision Alvium 1800 C-040m (Sony IMX287)",
    "source": _ALVIUM.format("C-040m"),
    "pixel_um": "6.9",
    "bits": 12,
    "wavelength_nm": 529,
    "qe_percent": 64,
    "dark_noise_e": "3.2",
    "threshold_e": "4.0",
    "saturation_e": 208_000,
    "dynamic_range_db": 74,
}
