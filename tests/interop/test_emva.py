"""Parts of DSNU and PRNU of the reference implementation of EMVA 1288."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs
from foveasim.metrics import emva1288

reference_data = other_program("emva1288.process.data")
reference_results = other_program("emva1288.process.results")

SHAPE, N_FRAMES = (60, 80), 8
PHOTONS = np.array([1000.0, 2000.0, 5000.0, 8000.0, 10_000.0, 12_000.0])


def frames_of(photons, rng, dark_dn, relative):
    mean = dark_dn + 0.25 * np.minimum(photons * relative, 10_000.0)
    deviation = np.sqrt(4.0 + (0.0 if photons > 10_000.0 else 0.25 * 0.25 * photons))
    return np.rint(mean + deviation * rng.normal(size=(N_FRAMES, *SHAPE))).astype(np.int64)


def reference(frames, dark):
    """Return the results of the reference implementation for a bright and a dark level."""
    images = {}
    for photons, stack in ((5000.0, frames[2]), (0.0, dark)):
        total = stack.sum(axis=0)
        images[photons] = {"sum": total, "pvar": ((len(stack) * stack - total) ** 2).sum(axis=0), "L": len(stack)}
    temporal = {}
    for photons, stack in zip((0.0, *PHOTONS), (dark, *frames), strict=True):
        pair = stack[0] + stack[1]
        temporal[photons] = {
            "sum": pair.sum(),
            "pvar": (2 * (stack[0] - stack[1]) ** 2).sum(),
            "dmean": (stack[0] - stack[1]).mean(),
        }
    data = {"width": SHAPE[1], "height": SHAPE[0], "temporal": {1.0: temporal}, "spatial": {1.0: images}}
    return reference_results.Results1288(reference_data.Data1288(data).data)


def test_parts_agree_with_reference_implementation():
    rng = np.random.default_rng(7)
    n_y, n_x = SHAPE
    dark_dn = 50.0 + rng.normal(0, 3, (n_y, 1)) + rng.normal(0, 2, (1, n_x)) + rng.normal(0, 4, SHAPE)
    relative = 1.0 + rng.normal(0, 0.006, (n_y, 1)) + rng.normal(0, 0.004, (1, n_x)) + rng.normal(0, 0.01, SHAPE)
    frames, dark = [frames_of(p, rng, dark_dn, relative) for p in PHOTONS], frames_of(0.0, rng, dark_dn, relative)
    found = emva1288(
        [f.reshape(N_FRAMES, -1) for f in frames],
        [dark.reshape(N_FRAMES, -1)],
        PHOTONS,
        layout=fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=3.0),
    )
    other = reference(frames, dark)
    # The reference divides squares by the numbers of rows and columns, instead of the degrees of freedom.
    tolerance = 1.5 / min(SHAPE)
    gain = found.gain_dn_per_e[0]
    for part, short in (("row", "row"), ("column", "col"), ("pixel", "pixel")):
        dsnu_dn, prnu = gain * getattr(found, f"dsnu_{part}_e")[0], getattr(found, f"prnu_{part}_fraction")[0]
        assert dsnu_dn == pytest.approx(np.sqrt(getattr(other, f"s_2_y_{short}_dark")), rel=tolerance)
        assert 100.0 * prnu == pytest.approx(getattr(other, f"PRNU1288_{short}"), rel=tolerance)
    # The reference does not subtract the variance of the means of frames from the temporal noise.
    assert gain * found.dsnu_e[0] == pytest.approx(np.sqrt(other.s_2_y_dark), rel=1e-3)
    assert 100.0 * found.prnu_fraction[0] == pytest.approx(other.PRNU1288, rel=1e-3)
