"""ENVI cubes of SPy: files that it writes, and headers that both programs read."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs

envi = other_program("spectral.io.envi")

#: Values [band, row, column], top row first.
VALUES = np.arange(3 * 4 * 5, dtype=np.float64).reshape(3, 4, 5) + 1.0
WAVES = [450.0, 550.0, 650.0]
RADIANCE = {"unit": "W m-2 sr-1 nm-1", "distance_m": 1.0}


def radiance(scene):
    """Return the spectral radiance [wavelength, row, column], top row first."""
    return np.einsum("byx,bk->kyx", scene.basis.astype(float), scene.spectrum_w_m2_sr_nm)[:, ::-1]


@pytest.mark.parametrize("interleave", ["bsq", "bil", "bip"])
@pytest.mark.parametrize(("dtype", "byteorder"), [("int16", 0), ("uint16", 1), ("float32", 1), ("float64", 0)])
def test_cubes_of_spy_are_read(tmp_path, interleave, dtype, byteorder):
    path = tmp_path / "cube.hdr"
    metadata = {
        "wavelength": WAVES,
        "wavelength units": "Nanometers",
        "fwhm": [5.0, 5.0, 5.0],
        "description": "a field",
    }
    cube = np.moveaxis(VALUES, 0, 2)
    envi.save_image(str(path), cube, dtype=dtype, interleave=interleave, byteorder=byteorder, metadata=metadata)
    scene = fs.Scene.from_cube(path, **RADIANCE)

    np.testing.assert_array_equal(radiance(scene), VALUES)
    assert scene.wavelength_nm.tolist() == WAVES


@pytest.mark.parametrize(
    "change",
    [
        str,
        lambda text: "\n".join(line.partition("=")[0].upper() + "=" + line.partition("=")[2] if "=" in line else line
                               for line in text.split("\n")),
        lambda text: text.replace("wavelength = {", "wavelength = {\n  "),
        lambda text: text + "; data type = 5\ndescription = {\n  byte order = 1 }\n",
    ],
    ids=["written", "upper case", "list on lines", "comments"],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:Parameters with non-lowercase names")
def test_headers_are_read_as_spy_does(tmp_path, change):
    path = tmp_path / "cube.hdr"
    metadata = {"wavelength": WAVES, "reflectance scale factor": 100.0, "bbl": [1, 0, 1]}
    envi.save_image(str(path), np.moveaxis(VALUES, 0, 2), dtype="int16", metadata=metadata)
    path.write_text(change(path.read_text()))
    image = envi.open(str(path))
    lit = {"distance_m": 1.0, "illuminant": "E", "radiance_w_m2_sr_nm": 1.0}
    scene = fs.Scene.from_cube(path, bands=[0, 1, 2], **lit)

    # SPy divides by the scale factor.
    np.testing.assert_allclose(radiance(scene), np.moveaxis(image.load(), 2, 0), rtol=1e-6)
    assert scene.wavelength_nm.tolist() == image.bands.centers
    assert fs.Scene.from_cube(path, **lit).wavelength_nm.tolist() == [450.0, 650.0]
