"""Checks of pupils, lens models and spectral curves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats
from foveasim.distortion import LENSES, Lens
from foveasim.errors import ParameterError
from foveasim.optics import PUPILS, Optics, PupilEdges
from foveasim.sensor.spectral import CURVES
from foveasim.testing._extension import Extension, check_of, require, shot_with

#: Points across the pupil, and the smallest jump of the amplitude between neighbours that requires an edge.
N_ACROSS, JUMP = 401, 0.5
#: Tolerance of powers that are sampled at these points.
SAMPLED = 0.01
WAVELENGTHS_NM = (450.0, 550.0, 650.0)
#: Radii of points relative to the focal length, and tolerance of positions relative to the radius.
RADII, POSITION_TOLERANCE = np.linspace(0.0, 0.3, 31), 1e-9
ROUNDING = 1e-12


@check_of(PUPILS)
def check_pupil(extension: Extension) -> None:
    """Check amplitudes, edges, and the power of the image of a point."""
    pupil = extension.make()
    at = np.linspace(-1.0, 1.0, 2 * N_ACROSS + 1, dtype=np.float64)[1::2]
    x, y = np.meshgrid(at, at)
    is_inside = x * x + y * y < 1.0
    power = np.zeros(len(WAVELENGTHS_NM))
    for k, wavelength_nm in enumerate(WAVELENGTHS_NM):
        amplitude = np.asarray(pupil(x, y, wavelength_nm))
        require(amplitude.shape == x.shape, f"must return amplitudes of the shape of its points, got {amplitude.shape}")
        values = np.abs(amplitude[is_inside].astype(np.complex128))
        require(np.isfinite(values).all(), "must return finite amplitudes")
        require(values.max() <= 1.0 + ROUNDING, f"must return amplitudes of at most 1, got {values.max():.6g}")
        rows = np.asarray(pupil(at[np.newaxis, :], at[:, np.newaxis], wavelength_nm))
        require(np.array_equal(np.broadcast_to(rows, x.shape), amplitude), "must support broadcasting of x and y")
        power[k] = np.mean(values**2)
        require(power[k] > 0.0, "must transmit power")
        _check_edges(pupil, np.abs(amplitude.astype(np.complex128)), is_inside, at)
    expected = extension.expected
    if expected is not None:
        require(abs(power[1] - expected) <= SAMPLED, f"transmits {power[1]:.4f} of the power, expected {expected:.4f}")
    _check_power(pupil, power[1])
    shot = shot_with("optics", {"pupil": extension.settings})
    by_file: Any = shot.camera.optics.pupil
    again = np.asarray(by_file(x, y, WAVELENGTHS_NM[0]))
    require(np.array_equal(again, pupil(x, y, WAVELENGTHS_NM[0])), "must be the same in a settings file")


def _check_edges(pupil: Any, values: NDArray[Any], is_inside: NDArray[np.bool_], at: Floats) -> None:
    """Check that an edge passes between neighbouring points with different amplitudes."""
    edges = pupil.edges() if hasattr(pupil, "edges") else PupilEdges()
    require(isinstance(edges, PupilEdges), f"must return PupilEdges by edges(), got {type(edges).__name__}")
    for axis in (0, 1):
        jumps = np.abs(np.diff(values, axis=axis)) > JUMP
        both = np.logical_and(*(np.take(is_inside, k, axis=axis) for k in (range(N_ACROSS - 1), range(1, N_ACROSS))))
        row, column = np.nonzero(jumps & both)
        middle = np.stack((at[column], at[row]), axis=1)
        middle[:, 1 - axis] += 1.0 / N_ACROSS
        away = _distances(edges, middle)
        require(
            np.all(away <= 2.0 / N_ACROSS),
            "has discontinuities that are not among its edges(); return them as PupilEdges, so that its PSF is exact",
        )


def _distances(edges: PupilEdges, points: Floats) -> Floats:
    """Return the distance of each point from the nearest edge."""
    x, y = points.T
    found = [np.full(x.size, np.inf)]
    found += [np.abs(np.hypot(x, y) - radius) for radius in np.asarray(edges.radii)]
    found += [np.abs(x - at) for at in np.asarray(edges.lines_x)]
    found += [np.abs(y - at) for at in np.asarray(edges.lines_y)]
    for start, stop in np.asarray(edges.segments):
        along = stop - start
        t = np.clip((points - start) @ along / max(float(along @ along), ROUNDING), 0.0, 1.0)
        found.append(np.hypot(*(points - start - t[:, np.newaxis] * along).T))
    return np.asarray(np.min(found, axis=0))


def _check_power(pupil: Any, fraction: float) -> None:
    """Compare the power in the image of a uniform scene with the transmitted fraction."""
    scene: Any = shot_with("sensor", {}).scene
    lens = Optics(focal_length_mm=8.0, f_number=4.0, padding="periodic")
    clear, found = (each.power_map(scene).data for each in (lens, replace(lens, pupil=pupil)))
    ratio = float(found.mean() / clear.mean())
    require(
        abs(ratio - fraction) <= SAMPLED,
        f"has a PSF with {ratio:.4f} of the power, but transmits {fraction:.4f}; check edges()",
    )


@check_of(LENSES)
def check_lens(extension: Extension) -> None:
    """Check that distort() and undistort() are inverse, and do not fold the image."""
    lens = extension.make()
    require(isinstance(lens, Lens), "must have focal_um, centre_um, distort() and undistort()")
    extension.check_dataclass(lens)
    focal_um, centre_um = np.min(lens.focal_um), np.asarray(lens.centre_um, np.float64)
    require(focal_um > 0.0, "must have a positive focal length")
    angle = np.arange(16) * (np.pi / 8.0) + 0.1
    offsets_um = focal_um * RADII[:, np.newaxis, np.newaxis] * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    ideal_um = centre_um + offsets_um
    real_um = np.asarray(lens.distort(ideal_um, outside="mask"))
    require(real_um.shape == ideal_um.shape, "must return points of the shape (..., 2) of its argument")
    is_valid = np.isfinite(real_um).all(axis=(1, 2))
    require(is_valid[:2].all(), "must map points near the centre")
    ideal_um, real_um = ideal_um[is_valid], real_um[is_valid]
    error_um = np.abs(np.asarray(lens.undistort(real_um)) - ideal_um).max()
    require(
        error_um <= POSITION_TOLERANCE * focal_um,
        f"has directions that are not inverse: undistort(distort(points)) differs from the points by up to {error_um:.3g} µm",
    )
    require(np.abs(real_um[0] - centre_um).max() <= POSITION_TOLERANCE * focal_um, "must map the centre to itself")
    steps, outwards = np.diff(real_um, axis=0), (ideal_um - centre_um)[1:]
    require(np.all(np.sum(steps * outwards, axis=2) > 0.0), "must map larger ideal radii to larger real radii")
    for point, expected in (extension.expected or {}).items():
        found = np.asarray(lens.distort([point]))[0]
        require(
            np.abs(found - expected).max() <= POSITION_TOLERANCE * focal_um,
            f"maps {point} to {found.round(4).tolist()}, expected {expected}",
        )
    again = extension.shot("distortion").camera.distortion
    require(to_plain_data(again) == to_plain_data(lens), "must be the same in a settings file")


@check_of(CURVES)
def check_curve(extension: Extension) -> None:
    """Check range, shape and wavelengths of a curve."""
    curve = extension.make()
    wavelength_nm = np.arange(300.0, 1101.0)

    def value_at(at_nm: float) -> float:
        try:
            found = np.asarray(curve(at_nm))
        except ParameterError:  # outside the range of the curve
            return np.nan
        require(found.shape == (), f"must return one number for one wavelength, got the shape {found.shape}")
        require(
            np.isfinite(found) and 0.0 <= found <= 1.0, f"must be from 0 to 1, got {float(found):.6g} at {at_nm:g} nm"
        )
        return float(found)

    values = np.array([value_at(each) for each in wavelength_nm])
    within = np.isfinite(values)
    visible = within[(wavelength_nm >= WAVELENGTHS_NM[0]) & (wavelength_nm <= WAVELENGTHS_NM[-1])]
    require(visible.all(), "must have values from 450 to 650 nm")
    inside_nm = wavelength_nm[within]
    n = 2 * (inside_nm.size // 2)
    array = np.asarray(curve(inside_nm[:n].reshape(2, -1)))
    require(array.shape == (2, n // 2), f"must return values of the shape of the wavelengths, got {array.shape}")
    require(
        np.allclose(array.ravel(), values[within][:n], rtol=1e-12, atol=1e-15), "must act on each wavelength separately"
    )
    for at_nm, expected in (extension.expected or {}).items():
        found = float(curve(at_nm))
        require(abs(found - expected) <= 1e-6, f"is {found:.6g} at {at_nm:g} nm, expected {expected:.6g}")
    shot = shot_with("sensor", {"qe": extension.settings})
    by_file: Any = shot.camera.sensor.qe
    require(np.array_equal(by_file(WAVELENGTHS_NM), curve(WAVELENGTHS_NM)), "must be the same in a settings file")
