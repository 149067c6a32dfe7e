"""PSFs of Optiland: their image points, pitches and orientation."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs

other_program("optiland")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the other program and its compiler
WAVE_UM = 0.55


@pytest.fixture(scope="module")
def triplet():
    from optiland.samples.objectives import CookeTriplet

    return CookeTriplet()


def huygens_psf(lens, field, n):
    """Return the PSF of a field point and the coordinates of its samples, µm; half of the window is 10 µm."""
    from optiland.psf import HuygensPSF

    huygens = HuygensPSF(lens, field, WAVE_UM, num_rays=48, image_size=n, pixel_pitch=0.02 / n)
    x, y, _ = (1e3 * np.asarray(each) for each in huygens._get_image_coordinates())
    # The image point is that of the chief ray, in the middle of the window.
    return np.asarray(huygens.psf), x[0] - x[0].mean(), y[:, 0] - y[:, 0].mean()


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.0, 0.7)])
def test_huygens_psf_is_in_its_middle(triplet, field):
    """An even number of samples on linspace has the image point between two of them."""
    about = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": 1e3 * WAVE_UM}
    found = []
    for n in (40, 41):
        values, x_um, y_um = huygens_psf(triplet, field, n)
        psfs = fs.optics.PSFGrid.from_arrays(values, sample_x_um=x_um, sample_y_um=y_um, **about)
        pitch_um = float(x_um[1] - x_um[0])
        same = fs.optics.PSFGrid.from_arrays(values, pitch_um=pitch_um, centre="middle", **about)
        np.testing.assert_allclose(psfs.centroid_um, same.centroid_um, atol=1e-9)
        assert psfs.centre == pytest.approx((20.0 - 0.5 * (n == 40),) * 2)
        assert pitch_um == pytest.approx(20.0 / (n - 1))
        found.append(psfs.centroid_um[0, 0])
    np.testing.assert_allclose(found[0], found[1], atol=0.02)
    assert abs(found[0][0]) < 1e-3  # symmetric about the tangential plane


def test_fft_psf_is_at_fftshift(triplet):
    from optiland.psf import FFTPSF

    values = np.asarray(FFTPSF(triplet, (0.0, 0.0), WAVE_UM, num_rays=128, grid_size=512).psf)
    psfs = fs.optics.PSFGrid.from_arrays(
        values, x_um=0.0, y_um=0.0, wavelength_nm=1e3 * WAVE_UM, pitch_um=1.0, centre="fft"
    )
    assert np.unravel_index(int(values.argmax()), values.shape) == (256, 256)
    np.testing.assert_allclose(psfs.centroid_um[0, 0], 0.0, atol=0.6)
    wrong = fs.optics.PSFGrid.from_arrays(
        values, x_um=0.0, y_um=0.0, wavelength_nm=1e3 * WAVE_UM, pitch_um=1.0, centre="middle"
    )
    np.testing.assert_allclose(wrong.centroid_um - psfs.centroid_um, 0.5, atol=1e-9)
