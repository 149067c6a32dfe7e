"""Published data sheets of the package, and one with a misprint."""

from foveasim.sensor.published.sheets import SHEETS

__all__ = ["MISPRINTED", "SHEETS"]

#: A sheet with an error of print: 208,000 e- for 20,800, 20 dB above its own dynamic range.
MISPRINTED = {
    "title": "Allied Vision Alvium 1800 C-040m (Sony IMX287)",
    "source": SHEETS["imx287"]["source"],
    "pixel_um": "6.9",
    "bits": 12,
    "wavelength_nm": 529,
    "qe_percent": 64,
    "dark_noise_e": "3.2",
    "threshold_e": "4.0",
    "saturation_e": 208_000,
    "dynamic_range_db": 74,
}
