"""Part of a sensor: fixed patterns, effects and noise of its sites are those in the complete sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.sensor import Sensor, noise_budget, signal_to_noise
from foveasim.sensor.effects import AdditiveNoise, Effect, FixedFactor, FixedOffset, InterPixelCapacitance

LAYOUT = fs.layout.mosaic(fs.layout.grid(n_x=40, n_y=25, pitch_um=2.0), ("RG", "GB"))
LAYOUT = LAYOUT.with_columns(readout_line=np.arange(1000) // 40)
N = LAYOUT.n_sites
PER_SITE = np.random.default_rng(0).uniform(0.5, 1.5, N)
PHOTO_E_PER_S = np.linspace(100.0, 2000.0, N)
#: A range, every third site, sites in another order, copies of a site.
SELECTIONS = [slice(200, 700), slice(5, None, 3), np.random.default_rng(1).permutation(N)[:300], np.full(7, 321)]


@dataclass(frozen=True)
class Shading(FixedFactor):
    """Test effect: loss that increases towards the corners of the layout."""

    name: ClassVar[str] = "shading"
    stage: ClassVar[str] = "photo"

    def pattern(self, sites):
        low, high = np.reshape(sites.layout.bounds_um, (2, 2))
        return 1.0 - 0.2 * np.sum(((sites.layout.centroid_um - low) / (high - low) - 0.5) ** 2, axis=1)


@dataclass(frozen=True, eq=False)
class OffsetPerSite(FixedOffset):
    """Test effect: an array per site."""

    name: ClassVar[str] = "offset_per_site"
    stage: ClassVar[str] = "output"

    offset_v: Any

    def pattern(self, sites):
        return self.offset_v


@dataclass(frozen=True)
class Ripple(AdditiveNoise):
    """Test effect: noise that increases with the index of the site."""

    name: ClassVar[str] = "ripple"
    stage: ClassVar[str] = "sense_node"

    def deviation(self, sites):
        return np.linspace(0.0, 0.01, sites.n_sites)


@dataclass(frozen=True)
class RankedGain(FixedFactor):
    """Test effect: a fixed pattern of random numbers that depends on all sites."""

    name: ClassVar[str] = "ranked_gain"
    stage: ClassVar[str] = "sense_node"

    def pattern(self, sites):
        return 0.9 + 0.2 * np.argsort(np.argsort(sites.device.normals(self.name))) / sites.n_sites

    def pattern_moments(self, sites):
        return 1.0, 0.2**2 / 12.0


@dataclass(frozen=True)
class Hum(Effect):
    """Test effect derived from Effect only: noise that increases from left to right."""

    name: ClassVar[str] = "hum"
    stage: ClassVar[str] = "charge"
    is_temporal: ClassVar[bool] = True

    def sigma_e(self, sites):
        return sites.select(sites.layout.centroid_um[:, 0] - sites.layout.bounds_um[0]) / 10.0

    def apply(self, values, *, sites, rng):
        return values + self.sigma_e(sites) * rng.standard_normal(values.size)

    def moments(self, mean, variance, *, sites):
        return mean, variance + self.sigma_e(sites) ** 2


USER_EFFECTS = [Shading(), OffsetPerSite(0.1 * PER_SITE), Ripple(), RankedGain(), Hum()]


def make_sensor(effects=USER_EFFECTS, **more):
    return Sensor(
        LAYOUT,
        filters="rgb",
        bits=14,
        v_sat_v=1.0,
        capacitance_f=1e-15,
        prnu_fraction=0.02,
        dsnu_fraction=0.2,
        dark_e_per_s=10.0 * PER_SITE,
        read_noise_e=PER_SITE,
        rts_fraction=0.2,
        rts_e=20.0,
        gain_fpn_fraction=0.01,
        pixel_fpn_fraction=0.01,
        line_fpn_fraction=0.02,
        sensitivity=PER_SITE / 1.5,
        effects=effects,
        **more,
    )


@pytest.mark.parametrize("selection", SELECTIONS)
def test_part_has_patterns_of_sensor(selection):
    sensor = make_sensor()
    part = sensor.part(selection)

    names = [effect.name for effect in sensor.chain if isinstance(effect, FixedFactor | FixedOffset)] + ["rts"]
    assert len(names) == 9
    for name in names:
        assert np.array_equal(part.pattern(name), sensor.pattern(name)[selection]), name
    assert np.array_equal(part.response, sensor.response[selection])
    assert np.array_equal(part.filter_of_site, sensor.filter_of_site[selection])


@pytest.mark.parametrize("selection", SELECTIONS)
def test_part_predicts_codes_of_sensor(selection):
    sensor = make_sensor()
    part = sensor.part(selection)
    complete = sensor.predict(sensor.expected_electrons(PHOTO_E_PER_S, 0.5))

    found = part.predict(part.expected_electrons(PHOTO_E_PER_S[selection], 0.5))

    for moment, of_all in zip(found, complete, strict=True):
        assert np.array_equal(moment, of_all[selection])


def test_part_has_noise_of_sensor():
    sensor = make_sensor()
    for name, per_site in (("shading", 0.0), ("offset_per_site", 0.0), ("ripple", 1.0), ("hum", 1.0), ("read", 1.0)):
        of_all, of_part = (
            noise_budget(each, rates, 0.5)[name]
            for each, rates in ((sensor, PHOTO_E_PER_S), (sensor.part(slice(200, 700)), PHOTO_E_PER_S[200:700]))
        )
        assert np.array_equal(of_part, of_all[200:700]), name
        assert (np.ptp(of_part) > 0.0) >= per_site
    charge_e, dark_e = np.full(N, 500.0), np.full(N, 5.0)
    ratios = signal_to_noise(sensor, charge_e, dark_e).ratio
    part = signal_to_noise(sensor.part(slice(200, 700)), charge_e[200:700], dark_e[200:700]).ratio
    assert np.array_equal(part, ratios[200:700])


def test_nested_parts_have_patterns_of_sensor():
    sensor = make_sensor()
    chosen = np.array([5, 300, 5])
    for part, index in (
        (sensor.part(slice(200, 700)).part(slice(100, 200)), np.arange(300, 400)),
        (sensor.part(slice(200, 700)).part(chosen), 200 + chosen),
        (sensor.part(slice(None, None, -1)).part(slice(100, 200)), np.arange(899, 799, -1)),
        (sensor.part(slice(200, 700)).without("read"), np.arange(200, 700)),
        (replace(sensor.part(slice(200, 700)), bits=10), np.arange(200, 700)),
    ):
        for name in ("shading", "offset_per_site", "ranked_gain", "prnu"):
            assert np.array_equal(part.pattern(name), sensor.pattern(name)[index]), name


def test_part_accepts_no_effects_between_sites():
    part = make_sensor().part(slice(200, 700))

    for change in (
        {"coupling": InterPixelCapacitance(neighbour_fraction=0.01)},
        {"device_seed": 5},
        {"layout": LAYOUT},
    ):
        with pytest.raises(ParameterError):
            replace(part, **change)


def test_part_of_arcs_has_numbers_of_sensor():
    """Whether an arc is identified by its outline depends on the other sites of the layout."""
    arc = fs.layout.log_polar(n_sectors=3, n_rings=60, r_min_um=5.0, r_max_um=60.0, chords_per_arc=8)[[170]]
    x, y = arc.centroid_um[0]
    pair = fs.Layout.from_polygons([arc.polygons()[0], shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)])
    sensor = Sensor(pair, prnu_fraction=0.1)

    for site in (0, 1):
        assert np.array_equal(sensor.part([site]).pattern("prnu"), sensor.pattern("prnu")[[site]])


def test_effect_without_layout_is_computed_for_part():
    """Its results are those of the sensor, from the sites of the part alone."""
    n_computed = []

    @dataclass(frozen=True)
    class Gain(FixedFactor):
        name: ClassVar[str] = "gain"
        stage: ClassVar[str] = "photo"
        needs_layout: ClassVar[bool] = False

        def pattern(self, sites):
            n_computed.append(sites.n_sites)
            return 1.0 + 0.1 * sites.device.normals(self.name)

    sensor = make_sensor([Gain()])

    assert np.array_equal(sensor.part(slice(200, 230)).pattern("gain"), sensor.pattern("gain")[200:230])
    assert n_computed == [30, N]


def test_part_draws_differ_only_by_stream():
    """Draws of a part follow its own blocks of sites; without noise, codes are those of the sensor."""
    sensor = make_sensor(shot_noise="off").without("read", "rts", "ripple", "hum")
    complete = sensor.expose(PHOTO_E_PER_S, 0.5, seed=0)

    found = sensor.part(SELECTIONS[2]).expose(PHOTO_E_PER_S[SELECTIONS[2]], 0.5, seed=0)

    for values, of_all in zip(found, complete, strict=True):
        assert np.array_equal(values, of_all[SELECTIONS[2]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.part("red"), "'selection' must be a slice, or a list of indices of the 1000 sites, got 'red'"),
        (lambda s: s.part([1000]), r"'selection' must be a slice, or a list .* got \[1000\]"),
        (lambda s: s.part(3), "'selection' must be a slice, or a list of indices of the 1000 sites, got 3"),
        (
            lambda s: replace(s.part([3]), device_seed=1),
            "'device_seed' must be 0 in part of a sensor, got 1; change it in",
        ),
        (lambda s: replace(make_part(s), layout=LAYOUT[:2]), "'layout' must have the 3 sites of the part, got 2"),
    ],
)
def test_invalid_parts_are_rejected(call, message):
    with pytest.raises(ParameterError, match=message):
        call(make_sensor())


def make_part(sensor):
    """Return a part without values per site."""
    return replace(sensor, dark_e_per_s=0.0, read_noise_e=0.0, sensitivity=1.0).part([1, 2, 3])
