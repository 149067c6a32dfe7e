"""Twin of a small camera, from Poisson and Gaussian numbers."""

from functools import cache

import numpy as np

import foveasim as fs


@cache
def small_twin():
    """Return the twin of 8 x 6 pixels of 4 µm with 11 bits, 0.3 DN/e- and a read noise of 5 e-."""
    rng = np.random.default_rng(4)

    def frames(signal_e):
        charge = rng.poisson(signal_e, (16, 6, 8)) + rng.normal(0.0, 5.0, (16, 6, 8))
        return np.rint(0.3 * charge + 50.0).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.0), 0.001, light=0)]
    stacks += [fs.twin.Stack(frames(500.0 * k), 0.01 * k, light=1) for k in range(1, 9)]
    return fs.twin.fit(stacks, bits=11, pixel_um=4.0)
