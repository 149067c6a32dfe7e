"""Every registered effect, alone and in pairs: drawn codes against predictions at five levels and three resolutions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import ClassVar

import numpy as np
import pytest
import scipy.constants
from reference.own_effects import Gates, RowNoise

from foveasim import Sensor
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, effects
from foveasim.sensor.effects import FixedFactor
from foveasim.sensor.limits import ALTERNATIVES

#: Levels of five rows of blocks, e-; a range of 4,000 e- with a pedestal of an eighth.
LEVELS_E, FULL_E, PEDESTAL = (3.0, 60.0, 400.0, 1500.0, 3000.0), 4000.0, 0.125
N_Y, N_FRAMES, EXPOSURE_S = 12, 60, 0.5
#: Rows within a level away from the borders between levels, where mixing makes a gradient.
INNER = slice(3, N_Y - 3)
FINE = {
    "v_sat_v": 1.0, "capacitance_f": FULL_E * scipy.constants.e, "pedestal_v": PEDESTAL, "read_noise_e": 2.0, "dark_e_per_s": 4.0,
}  # fmt: skip


@dataclass(frozen=True)
class Shading(FixedFactor):
    """Test effect: transmission that is the same for all devices."""

    name: ClassVar[str] = "shading"
    stage: ClassVar[str] = "photo"

    def pattern(self, sites):
        column = sites.layout.readout_line
        return 0.6 + 0.4 * column / column.max()


#: Keywords that enable an effect, scaled to the range, by name.
CASES = {effect.name: dict(effect.example) for effect in effects.STANDARD} | {
    "hot": {"hot_fraction": 0.05, "hot_e_per_s": 500.0},
    "dsnu": {"dark_e_per_s": 60.0, "dsnu_fraction": 0.3},
    "crosstalk": {"crosstalk": Diffusion(spread_um=0.3)},
    "ipc": {"coupling": InterPixelCapacitance(neighbour_fraction=0.02)},
    "exact": {"shot_noise": "exact"},
    "columns": {"effects": [RowNoise(6.0)]},
    "shading": {"effects": [Shading()]},
    "gates": {"effects": [Gates(4000)]},
}  # fmt: skip
PAIRS = [(name,) for name in CASES] + list(combinations(CASES, 2))


def merge(names):
    """Return the keywords of several effects; None where they exclude each other."""
    merged = {"effects": []}
    for name in names:
        own = dict(CASES[name])
        merged["effects"] = [*merged["effects"], *own.pop("effects", [])]
        merged |= own
    n_collections = sum(effect.stage == "collection" for effect in merged["effects"])
    is_twice = any(merged.keys() >= {*pair} for pair in ALTERNATIVES)
    return None if is_twice or n_collections + ("shot_noise" in merged) > 1 else merged


@cache
def layout_of(n_x):
    layout = grid(n_x=n_x, n_y=N_Y * len(LEVELS_E), pitch_um=2.0)
    return layout.with_columns(readout_line=np.arange(layout.n_sites) % n_x)


@pytest.mark.slow(keep=len(CASES))
@pytest.mark.parametrize("names", [pair for pair in PAIRS if merge(pair)], ids="-".join)
def test_draws_match_predictions(names):
    # The binomial distributions of gates are slow.
    n_x = 20 if "gates" in names else 60
    layout = layout_of(n_x)
    site = np.arange(layout.n_sites).reshape(len(LEVELS_E), N_Y, n_x)
    rate = np.repeat(LEVELS_E, N_Y * n_x) / EXPOSURE_S
    for bits in (1, 8, 12):
        # With one bit the threshold is at the third level.
        changes = {"v_sat_v": 2.0 * (400.0 / FULL_E + PEDESTAL)} if bits == 1 else {}
        sensor = Sensor(layout, **{**FINE, "bits": bits, **changes, **merge(names)})
        mean_dn, variance_dn2 = sensor.predict(sensor.expected_electrons(rate, EXPOSURE_S), exposure_s=EXPOSURE_S)
        codes = np.stack([sensor.expose(rate, EXPOSURE_S, seed=7, frame=k)[2] for k in range(N_FRAMES)]).astype(float)
        for level, level_e in enumerate(LEVELS_E):
            chosen = site[level, INNER].ravel()
            is_random = variance_dn2[chosen] > 1e-9
            # Rare codes need more frames.
            is_common = variance_dn2[chosen] > 1e-3
            exact = codes[:, chosen][:, ~is_random] - mean_dn[chosen][~is_random]
            assert np.abs(exact).max(initial=0.0) < 1e-2, (bits, level_e)
            if is_common.sum() < 30:
                continue
            off = (codes - mean_dn)[:, chosen][:, is_common]
            # Sums over the sites of a frame: sites may be correlated, frames are not.
            sums = off.sum(axis=1)
            squares = np.square(off).sum(axis=1) / variance_dn2[chosen][is_common].sum() - 1.0
            for values, what in ((sums, "mean"), (squares, "variance")):
                error = values.std(ddof=1) / np.sqrt(N_FRAMES)
                assert abs(values.mean()) < 5.0 * error + 1e-9, (what, bits, level_e, values.mean() / error)
