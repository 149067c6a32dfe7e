"""Quantum efficiencies and colour filters against the Beer-Lambert law, tables and closed forms."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.config import read_shot
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.sensor import (
    BandMean,
    ConstantCurve,
    FilterSet,
    GaussianCurve,
    PassBand,
    PolynomialCurve,
    ProductCurve,
    SiliconQE,
    SplineCurve,
    StepCurve,
    TableCurve,
    camera_filters,
    ccd_qe,
    read_curve,
    read_filters,
    rgb_filters,
)

EPS = np.finfo(float).eps

#: Published absorption lengths of silicon, µm by nm.
ABSORPTION_UM = {400: 0.0971, 500: 0.8195, 550: 1.561, 650: 3.580, 800: 12.09, 1000: 162.3, 1050: 640.7}


# -- silicon --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("wavelength_nm", "length_um"), ABSORPTION_UM.items())
def test_silicon_absorbs_63_percent_per_absorption_length(wavelength_nm, length_um):
    assert math.isclose(SiliconQE(depth_um=length_um)(wavelength_nm), 0.6321205588285577, rel_tol=4 * EPS)


@pytest.mark.parametrize(
    ("wavelength_nm", "depth_um", "expected"),
    [
        (400, 0.05, 0.4024594),  # 1 - exp(-0.5149331)
        (550, 3.0, 0.8536633),  # 1 - exp(-1.9218450)
        (650, 3.0, 0.5674204),  # 1 - exp(-0.8379888)
        (1000, 10.0, 0.0597545),  # 1 - exp(-0.0616143)
    ],
)
def test_silicon_absorption_matches_beer_lambert_law(wavelength_nm, depth_um, expected):
    assert abs(SiliconQE(depth_um=depth_um)(wavelength_nm) - expected) < 5e-7


@pytest.mark.parametrize("wavelength_nm", [400.0, 437.0, 620.0, 999.0, 1050.0])
def test_silicon_layer_transmissions_multiply(wavelength_nm):
    one, two = (1.0 - SiliconQE(depth_um=d)(wavelength_nm) for d in (1.3, 2.6))
    assert abs(two - one**2) < 4 * EPS


@pytest.mark.parametrize("transmission", [0.3, 0.7, 1.0])
def test_thick_silicon_reaches_entrance_transmission(transmission):
    wavelength_nm = np.linspace(400, 1050, 27)
    np.testing.assert_allclose(
        SiliconQE(depth_um=1e5, transmission=transmission)(wavelength_nm), transmission, rtol=4 * EPS
    )


@pytest.mark.parametrize(("wavelength_nm", "length_um"), ABSORPTION_UM.items())
def test_thin_silicon_absorption_is_linear_in_depth(wavelength_nm, length_um):
    depth_um = 1e-9  # relative error of the linear term: depth / (2 length)
    assert math.isclose(SiliconQE(depth_um=depth_um)(wavelength_nm), depth_um / length_um, rel_tol=1e-7)


def test_silicon_absorption_decreases_with_wavelength():
    assert np.all(np.diff(SiliconQE(depth_um=3.0)(np.arange(400.0, 1051.0))) < 0.0)


def test_absorption_length_is_interpolated_logarithmically():
    absorbed = SiliconQE(depth_um=1.0)(525.0)
    assert math.isclose(-1.0 / math.log(1.0 - absorbed), math.sqrt(0.8195 * 1.561), rel_tol=1e-12)


@pytest.mark.parametrize("outside_nm", [399.9, 300.0, 1050.1, math.inf, -math.inf])
def test_silicon_rejects_wavelengths_outside_table(outside_nm):
    with pytest.raises(ParameterError, match=rf"must be within .*silicon.*400 to 1050 nm, got {outside_nm} nm$"):
        SiliconQE(depth_um=3.0)([500.0, outside_nm])


@pytest.mark.parametrize(
    "curve",
    [SiliconQE(depth_um=3.0), PolynomialCurve(wavelength_nm=[400, 500], value=[0.1, 0.2], degree=1)],
    ids=["silicon", "polynomial"],
)
def test_nan_wavelength_is_rejected(curve):
    with pytest.raises(ParameterError, match=r"^'wavelength_nm' must "):
        curve([450.0, math.nan])


@pytest.mark.parametrize(
    ("parameters", "name"),
    [
        ({"depth_um": 0.0}, "depth_um"),
        ({"depth_um": -1.0}, "depth_um"),
        ({"depth_um": math.nan}, "depth_um"),
        ({"depth_um": "3"}, "depth_um"),
        ({"depth_um": 1e6}, "depth_um"),
        ({"depth_um": 3.0, "transmission": 0.0}, "transmission"),
        ({"depth_um": 3.0, "transmission": 1.1}, "transmission"),
    ],
)
def test_invalid_silicon_parameters_are_rejected(parameters, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be"):
        SiliconQE(**parameters)


# -- polynomials ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 5])
def test_fit_reproduces_polynomial_of_same_degree(degree):
    def truth(wavelength_nm):
        u = (np.asarray(wavelength_nm) - 400.0) / 600.0
        return sum(0.15 * (-u) ** k for k in range(degree + 1)) + 0.3

    table_nm = np.linspace(400.0, 1000.0, 13)
    curve = PolynomialCurve(wavelength_nm=table_nm, value=truth(table_nm), degree=degree)
    between_nm = np.linspace(400.0, 1000.0, 101)
    np.testing.assert_allclose(curve(between_nm), truth(between_nm), rtol=0, atol=1e-13)


def test_fit_of_highest_degree_interpolates_values():
    table_nm, values = [400.0, 450.0, 600.0, 650.0, 700.0], [0.2, 0.5, 0.4, 0.6, 0.1]
    np.testing.assert_allclose(
        PolynomialCurve(wavelength_nm=table_nm, value=values, degree=4)(table_nm), values, rtol=0, atol=1e-12
    )


def test_fit_of_degree_zero_is_mean():
    assert math.isclose(PolynomialCurve(wavelength_nm=[400, 500, 900], value=[0.1, 0.2, 0.6], degree=0)(444.0), 0.3)


def test_fit_residuals_are_orthogonal_to_powers():
    rng = np.random.default_rng(3)
    table_nm, values = np.linspace(400.0, 900.0, 21), rng.uniform(0.2, 0.8, 21)
    residuals = values - PolynomialCurve(wavelength_nm=table_nm, value=values, degree=2)(table_nm)
    powers = np.vander((table_nm - 650.0) / 250.0, 3)
    np.testing.assert_allclose(residuals @ powers, 0.0, atol=1e-13)


def test_fit_is_independent_of_table_order():
    table_nm, values = np.array([400.0, 500.0, 600.0, 700.0]), np.array([0.1, 0.5, 0.6, 0.2])
    shuffled = np.array([2, 0, 3, 1])
    curves = [
        PolynomialCurve(wavelength_nm=table_nm[order], value=values[order], degree=2)
        for order in (slice(None), shuffled)
    ]
    np.testing.assert_allclose(curves[0](550.0), curves[1](550.0), rtol=1e-13)


def test_polynomial_is_clipped_to_unit_range():
    curve = PolynomialCurve(wavelength_nm=[400, 500, 600, 700], value=[1.0, 0.0, 0.0, 1.0], degree=2)
    between = curve(np.linspace(400, 700, 301))
    # The unclipped least-squares parabola has a minimum of -0.125.
    assert between.min() == 0.0
    assert between.max() <= 1.0


def test_degree_accepts_integers_of_any_type():
    curves = [
        PolynomialCurve(wavelength_nm=[400, 500, 600], value=[0.1, 0.4, 0.2], degree=degree)
        for degree in (2, np.int64(2), 2.0)
    ]
    assert all(a(555.0) == b(555.0) for a, b in itertools.pairwise(curves))


@pytest.mark.parametrize("outside_nm", [399.0, 701.0, math.inf])
def test_polynomial_rejects_wavelengths_outside_table(outside_nm):
    curve = PolynomialCurve(wavelength_nm=[700, 400, 500], value=[0.1, 0.2, 0.3], degree=1)
    with pytest.raises(ParameterError, match=rf"must be within the table .*400 to 700 nm, got {outside_nm} nm$"):
        curve(outside_nm)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"wavelength_nm": [400, 500]}, "'value' must have the same length as 'wavelength_nm'"),
        ({"wavelength_nm": [500], "value": [0.5], "degree": 0}, "'value' must have .* at least 2, got 1"),
        ({"wavelength_nm": [], "value": [], "degree": 0}, "'value' must have .* at least 2, got 0"),
        ({"wavelength_nm": [400, 400, 600]}, "'wavelength_nm' must not repeat a wavelength"),
        ({"wavelength_nm": [400, -1, 600]}, r"'wavelength_nm' must be > 0.0 everywhere, got -1.0 nm at \[1\]"),
        ({"wavelength_nm": [400, math.nan, 600]}, r"'wavelength_nm' must be finite everywhere, got nan nm at \[1\]"),
        ({"wavelength_nm": [[400, 500, 600]]}, "'wavelength_nm' must have 1 dimension"),
        ({"wavelength_nm": ["a", "b", "c"]}, "'wavelength_nm' must be an array of numbers"),
        ({"value": [0.1, 1.2, 0.3]}, "'value' must be <= 1 everywhere, got 1.2"),
        ({"value": [0.1, -0.1, 0.3]}, r"'value' must be >= 0.0 everywhere, got -0.1 at \[1\]"),
        ({"value": [0.1, math.inf, 0.3]}, "'value' must be finite everywhere"),
        ({"degree": 3}, "'degree' must be <= 2"),
        ({"degree": -1}, "'degree' must be >= 0"),
        ({"degree": 1.5}, "'degree' must be an integer"),
    ],
)
def test_invalid_table_is_rejected(changed, message):
    table = {"wavelength_nm": [400, 500, 600], "value": [0.1, 0.2, 0.3], "degree": 1} | changed
    with pytest.raises(ParameterError, match=f"^{message}[^\n]*$"):
        PolynomialCurve(**table)


# -- other curves ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 0.35, 1.0])
def test_constant_curve_is_constant(value):
    assert np.all(ConstantCurve(value)(np.array([1.0, 550.0, 1e6])) == value)


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, "1", None])
def test_constant_outside_range_is_rejected(value):
    with pytest.raises(ParameterError, match=r"^'value' must be"):
        ConstantCurve(value)


def test_gaussian_curve_has_stated_fwhm():
    curve = GaussianCurve(centre_nm=540.0, fwhm_nm=90.0, peak=0.8)
    np.testing.assert_allclose(curve([495.0, 540.0, 585.0]), [0.4, 0.8, 0.4], rtol=4 * EPS)


def test_gaussian_curve_area_is_1_0645_fwhm():
    wavelength_nm = np.arange(100.0, 1000.0)
    # sqrt(pi / (4 ln 2)) = 1.06446701943; for a Gaussian of this width the trapezoidal rule is exact to rounding
    area_nm = GaussianCurve(centre_nm=540.0, fwhm_nm=90.0)(wavelength_nm).sum()
    assert math.isclose(area_nm, 1.06446701943 * 90.0, rel_tol=1e-10)


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"centre_nm": 0.0}, "centre_nm"),
        ({"fwhm_nm": 0.0}, "fwhm_nm"),
        ({"fwhm_nm": math.inf}, "fwhm_nm"),
        ({"peak": 0.0}, "peak"),
        ({"peak": 1.5}, "peak"),
    ],
)
def test_invalid_gaussian_curve_is_rejected(changed, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be"):
        GaussianCurve(**({"centre_nm": 540.0, "fwhm_nm": 90.0} | changed))


def test_filters_retain_order():
    filters = FilterSet([ConstantCurve(0.2), ConstantCurve(0.7)], ["dark", "light"])
    np.testing.assert_array_equal(filters.transmission(np.array([500.0, 600.0])), [[0.2, 0.2], [0.7, 0.7]])


def test_filters_without_names_are_numbered():
    assert FilterSet([ConstantCurve()] * 3).names == ("0", "1", "2")


@pytest.mark.parametrize(("wavelength_nm", "name"), [(620.0, "R"), (550.0, "G"), (450.0, "B")])
def test_each_primary_has_highest_matching_transmission(wavelength_nm, name):
    filters = rgb_filters()
    assert filters.names[int(np.argmax(filters.transmission(np.array([wavelength_nm]))))] == name


@pytest.mark.parametrize(
    ("curves", "names", "message"),
    [
        ([], None, "'curves' must be one or more functions of wavelength"),
        ([0.5], None, r"'curves\[0\]' must be a Curve, got a float"),
        ("ab", None, "'curves' must be a list of Curve objects, got 'ab'"),
        ([ConstantCurve()], ["a", "b"], "'names' must have one name for each of the 1 curves"),
    ],
)
def test_invalid_filter_set_is_rejected(curves, names, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        FilterSet(curves, names)


# -- tables ---------------------------------------------------------------------------------------------------------

RAGGED = {"wavelength_nm": [400, 410, 470, 475, 600, 700], "value": [0.0, 1.0, 1.0, 0.2, 0.3, 0.0]}


def test_table_curve_interpolates_linearly():
    curve = TableCurve(wavelength_nm=[500, 400, 700], value=[0.8, 0.2, 0.0])
    np.testing.assert_allclose(curve([400, 425, 500, 600, 700]), [0.2, 0.35, 0.8, 0.4, 0.0], rtol=0, atol=2 * EPS)


@pytest.mark.parametrize("kind", [TableCurve, SplineCurve])
def test_table_and_spline_interpolate_values(kind):
    np.testing.assert_allclose(kind(**RAGGED)(RAGGED["wavelength_nm"]), RAGGED["value"], rtol=0, atol=2 * EPS)


def test_spline_is_monotonic_between_values():
    curve = SplineCurve(**RAGGED)
    for (low, high), ends in zip(
        itertools.pairwise(RAGGED["wavelength_nm"]), itertools.pairwise(RAGGED["value"]), strict=True
    ):
        between = curve(np.linspace(low, high, 501))
        assert np.all(between >= min(ends) - EPS)
        assert np.all(between <= max(ends) + EPS)
        assert np.all(np.diff(between) * np.sign(ends[1] - ends[0]) >= -EPS)


def test_random_splines_stay_within_range():
    rng = np.random.default_rng(5)
    for _ in range(50):
        curve = SplineCurve(
            wavelength_nm=np.cumsum(rng.uniform(0.01, 50, 12)) + 300, value=np.round(rng.uniform(0, 1, 12))
        )
        between = curve(np.linspace(curve.wavelength_nm[0], curve.wavelength_nm[-1], 2001))
        assert between.min() == 0.0
        assert between.max() == 1.0


def test_spline_reproduces_straight_line():
    curve = SplineCurve(wavelength_nm=[400, 450, 700], value=[0.1, 0.15, 0.4])
    waves_nm = np.linspace(400, 700, 31)
    np.testing.assert_allclose(curve(waves_nm), waves_nm / 1000 - 0.3, rtol=0, atol=4 * EPS)


def test_spline_beats_linear_interpolation():
    table_nm, between_nm = np.arange(400.0, 701.0, 20.0), np.linspace(400, 700, 1201)
    truth = GaussianCurve(centre_nm=560.0, fwhm_nm=120.0)  # the maximum is at a wavelength of the table
    worst = [
        np.abs(kind(wavelength_nm=table_nm, value=truth(table_nm))(between_nm) - truth(between_nm)).max()
        for kind in (SplineCurve, TableCurve)
    ]
    assert 3.0 * worst[0] < worst[1] < 0.02


def test_step_edge_belongs_to_following_value():
    curve = StepCurve(edge_nm=[400, 500, 700], value=[0.2, 0.6])
    np.testing.assert_array_equal(curve([400, 499.999, 500, 700]), [0.2, 0.2, 0.6, 0.6])


@pytest.mark.parametrize(
    "curve",
    [
        TableCurve(wavelength_nm=[400, 700], value=[0.3, 0.5]),
        SplineCurve(wavelength_nm=[400, 700], value=[0.3, 0.5]),
        StepCurve(edge_nm=[400, 550, 700], value=[0.3, 0.5]),
    ],
    ids=["lines", "spline", "steps"],
)
class TestOutsideTable:
    @pytest.mark.parametrize("outside_nm", [399.9, 700.1, math.inf, math.nan])
    def test_outside_wavelengths_are_rejected_with_hint(self, curve, outside_nm):
        with pytest.raises(
            ParameterError, match=rf"must be within the table, 400 to 700 nm, got {outside_nm} nm; set beyond="
        ):
            curve([500.0, outside_nm])

    def test_zero_extrapolation_returns_zero(self, curve):
        np.testing.assert_array_equal(
            dataclasses.replace(curve, beyond="zero")([399.9, 400, 700, 701]), [0, 0.3, 0.5, 0]
        )

    def test_hold_extrapolation_returns_end_value(self, curve):
        np.testing.assert_array_equal(
            dataclasses.replace(curve, beyond="hold")([1.0, 400, 700, 9e5]), [0.3, 0.3, 0.5, 0.5]
        )

    @pytest.mark.parametrize("beyond", ["zero", "hold"])
    def test_nan_is_rejected_with_extrapolation(self, curve, beyond):
        with pytest.raises(ParameterError, match=r"^'wavelength_nm' must be within"):
            dataclasses.replace(curve, beyond=beyond)(math.nan)

    def test_curve_preserves_wavelength_shape(self, curve):
        assert curve(550.0).shape == ()
        assert curve(np.full((2, 3), 550.0)).shape == (2, 3)

    def test_unknown_beyond_is_rejected(self, curve):
        with pytest.raises(ParameterError, match=r"^'beyond' must be one of 'raise', 'zero', 'hold', got 'guess'$"):
            dataclasses.replace(curve, beyond="guess")


@pytest.mark.parametrize("kind", [TableCurve, SplineCurve, PolynomialCurve])
def test_wavelengths_in_micrometres_are_rejected(kind):
    with pytest.raises(
        ParameterError, match=r"must be from 10 to 1e\+06, got \[0.4, 0.5, 0.6\] nm; wavelengths are in nm"
    ):
        kind(wavelength_nm=[0.4, 0.5, 0.6], value=[0.1, 0.2, 0.3], **({"degree": 1} if kind is PolynomialCurve else {}))


@pytest.mark.parametrize(
    ("edge_nm", "value", "message"),
    [
        ([400, 500], [0.1, 0.2], "'edge_nm' must have one element more than 'value', which has 2, got 2"),
        ([400], [], "'edge_nm' must have one element more than 'value'"),
        ([400, 400], [0.1], "'edge_nm' must ascend"),
        ([500, 400], [0.1], "'edge_nm' must ascend"),
        ([400, 500], [1.1], "'value' must be <= 1 everywhere, got 1.1"),
        ([400, 500], [-0.1], "'value' must be >= 0.0 everywhere"),
        ([400, math.nan], [0.1], "'edge_nm' must be finite everywhere"),
    ],
)
def test_invalid_steps_are_rejected(edge_nm, value, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        StepCurve(edge_nm=edge_nm, value=value)


# -- pass bands -----------------------------------------------------------------------------------------------------

WAVES_NM = np.linspace(300.0, 1100.0, 801)


def test_edge_width_is_10_to_90_percent():
    curve = PassBand(from_nm=600.0, edge_nm=40.0, peak=0.8)
    np.testing.assert_allclose(curve([580.0, 600.0, 620.0]), [0.08, 0.4, 0.72], rtol=8 * EPS)


@pytest.mark.parametrize("edge_nm", [0.0, 5.0, 80.0])
def test_long_pass_and_short_pass_are_complementary(edge_nm):
    both = PassBand(from_nm=600.0, edge_nm=edge_nm)(WAVES_NM) + PassBand(to_nm=600.0, edge_nm=edge_nm)(WAVES_NM)
    np.testing.assert_allclose(both, 1.0, rtol=0, atol=2 * EPS)


@pytest.mark.parametrize("edge_nm", [0.0, 5.0, 80.0])
def test_adjacent_pass_bands_add_up(edge_nm):
    first, second, both = (
        PassBand(from_nm=a, to_nm=b, edge_nm=edge_nm)(WAVES_NM) for a, b in ((450, 520), (520, 700), (450, 700))
    )
    np.testing.assert_allclose(first + second, both, rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("edge_nm", [5.0, 40.0, 200.0])
def test_pass_band_area_is_width_times_peak(edge_nm):
    waves_nm = np.arange(-2000.0, 3500.0)  # for these edge widths the sum in steps of 1 nm equals the area to 1e-6
    assert math.isclose(PassBand(from_nm=500, to_nm=620, edge_nm=edge_nm, peak=0.5)(waves_nm).sum(), 60.0, rel_tol=1e-6)


@pytest.mark.parametrize("parameters", [{"to_nm": 650.0}, {"from_nm": 650.0}, {"from_nm": 500.0, "to_nm": 501.0}])
@pytest.mark.parametrize("edge_nm", [0.0, 1e-9, 3.0, 1e4])
def test_pass_band_stays_within_unit_range(parameters, edge_nm):
    passed = PassBand(**parameters, edge_nm=edge_nm)(np.linspace(1.0, 1e6, 100_001))
    assert passed.min() >= 0.0
    assert passed.max() <= 1.0


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "'from_nm' or 'to_nm' must be given"),
        ({"from_nm": 0.0}, "'from_nm' must be > 0"),
        ({"from_nm": 500.0, "to_nm": 500.0}, "'to_nm' must be > 500, got 500.0 nm"),
        ({"to_nm": math.nan}, "'to_nm' must be finite"),
        ({"to_nm": 500.0, "edge_nm": -1.0}, "'edge_nm' must be >= 0"),
        ({"to_nm": 500.0, "peak": 1.5}, "'peak' must be <= 1"),
    ],
)
def test_invalid_pass_bands_are_rejected(parameters, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        PassBand(**parameters)


# -- products -------------------------------------------------------------------------------------------------------

SILICON, GREEN, CUT = SiliconQE(depth_um=3.0), GaussianCurve(centre_nm=540.0, fwhm_nm=90.0), PassBand(to_nm=650.0)


def test_product_curve_multiplies_values():
    waves_nm = np.linspace(400.0, 1050.0, 66)
    np.testing.assert_array_equal((SILICON * GREEN)(waves_nm), SILICON(waves_nm) * GREEN(waves_nm))


def test_nested_products_are_flattened():
    assert (SILICON * GREEN) * CUT == SILICON * (GREEN * CUT) == ProductCurve([SILICON, GREEN, CUT])
    assert (SILICON * 0.5).curves == (SILICON, ConstantCurve(0.5))


def test_product_is_independent_of_order():
    waves_nm = np.linspace(400.0, 1050.0, 66)
    values = [ProductCurve(order)(waves_nm) for order in itertools.permutations([SILICON, GREEN, CUT, 0.9])]
    assert all(np.allclose(a, values[0], rtol=8 * EPS, atol=0) for a in values)


@pytest.mark.parametrize("number", [0.25, np.float64(0.25), np.array(0.25), 1, 0])
def test_scalar_multiplication_is_commutative(number):
    for curve in (CUT * number, number * CUT):
        np.testing.assert_allclose(curve([600.0, 650.0]), CUT([600.0, 650.0]) * float(number), rtol=2 * EPS)


def test_product_accepts_plain_function():
    assert ((lambda waves_nm: np.asarray(waves_nm) / 1000.0) * ConstantCurve(0.5))(500.0) == 0.25


def test_product_domain_is_intersection():
    with pytest.raises(ParameterError, match=r"must be within the absorption table of silicon, 400 to 1050 nm"):
        (GREEN * SILICON)(390.0)


@pytest.mark.parametrize("factor", [1.5, -0.1, math.nan, "0.5", None])
def test_invalid_factor_is_rejected(factor):
    with pytest.raises(ParameterError, match=r"^'curves(\[1\])?' must be"):
        SILICON * factor


@pytest.mark.parametrize("curves", [[], "ab", None, 0.5])
def test_empty_product_is_rejected(curves):
    with pytest.raises(ParameterError, match=r"^'curves' must be (one or more curves or numbers|a list of)"):
        ProductCurve(curves)


def test_filter_set_times_curve_multiplies_each():
    waves_nm = np.linspace(400.0, 700.0, 31)
    cut = rgb_filters() * CUT
    assert cut.names == ("R", "G", "B")
    np.testing.assert_array_equal(cut.transmission(waves_nm), rgb_filters().transmission(waves_nm) * CUT(waves_nm))


def test_filter_set_times_list_multiplies_elementwise():
    filters = rgb_filters() * [SILICON, 0.5, GREEN]
    factors = np.stack([SILICON([500.0, 600.0]), [0.5, 0.5], GREEN([500.0, 600.0])])
    waves_nm = np.array([500.0, 600.0])
    np.testing.assert_array_equal(filters.transmission(waves_nm), rgb_filters().transmission(waves_nm) * factors)


@pytest.mark.parametrize("factor", [[0.5, 0.5], [], [0.5] * 4, 1.5, "rgb", None, [0.5, 0.5, 2.0]])
def test_mismatched_filter_factors_are_rejected(factor):
    with pytest.raises(ParameterError, match=r"^'factor' must be"):
        rgb_filters() * factor


# -- combination in a sensor ------------------------------------------------------------------------------------------


def bayer():
    return fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0), ("RG", "GB"))


def test_quantum_efficiency_can_be_in_filters():
    waves_nm = np.linspace(400.0, 700.0, 7)
    separate = fs.Sensor(bayer(), qe=SILICON * CUT, filters="rgb")
    combined = fs.Sensor(bayer(), filters=rgb_filters() * SILICON * CUT)
    np.testing.assert_allclose(
        separate.responsivity_e_per_j(waves_nm), combined.responsivity_e_per_j(waves_nm), rtol=8 * EPS
    )


# -- band means -------------------------------------------------------------------------------------------------------


def test_band_mean_of_constant_is_constant():
    assert math.isclose(BandMean(curve=ConstantCurve(0.3), band_width_nm=40.0)(550.0), 0.3, rel_tol=8 * EPS)


def test_band_mean_of_line_is_photon_weighted():
    line = TableCurve(wavelength_nm=[400, 800], value=[0.4, 0.8])  # value = wavelength / 1000
    # Mean of x² / 1000 over c ± w/2, divided by c: (c² + w²/12) / (1000 c).
    mean = BandMean(curve=line, band_width_nm=100.0, n_points=10_000)(600.0)
    assert math.isclose(mean, (600.0**2 + 100.0**2 / 12) / 600e3, rel_tol=1e-8)


def test_band_mean_equals_mean_of_halves():
    curve = GaussianCurve(centre_nm=551.0, fwhm_nm=7.0)
    full = BandMean(curve=curve, band_width_nm=40.0, n_points=64)(560.0) * 560.0
    halves = BandMean(curve=curve, band_width_nm=20.0, n_points=32)([550.0, 570.0]) * [550.0, 570.0]
    assert math.isclose(full, halves.mean(), rel_tol=16 * EPS)


@pytest.mark.parametrize(("shift_nm", "fraction_at_points"), [(0.0, 1.8797), (10.0, 0.2349)])
def test_band_means_conserve_electrons_of_narrow_filter(shift_nm, fraction_at_points):
    narrow = GaussianCurve(centre_nm=550.0 + shift_nm, fwhm_nm=10.0)
    waves_nm = np.arange(450.0, 651.0, 20.0)
    photons = 1.06446701943 * 10.0 * narrow.centre_nm  # area times the mean wavelength of a symmetric band
    at_points = (narrow(waves_nm) * waves_nm).sum() * 20.0 / photons
    over_bands = (BandMean(curve=narrow, band_width_nm=20.0)(waves_nm) * waves_nm).sum() * 20.0 / photons
    assert abs(at_points - fraction_at_points) < 1e-3
    assert abs(over_bands - 1.0) < 1e-9


def test_band_means_hardly_change_broad_filters():
    waves_nm = np.arange(400.0, 701.0, 10.0)
    photons = [
        (f.transmission(waves_nm) * waves_nm).sum(axis=1) for f in (rgb_filters(), rgb_filters().over_bands(10.0))
    ]
    np.testing.assert_allclose(photons[0], photons[1], rtol=1e-3)


def test_band_mean_preserves_shape_and_range():
    mean = BandMean(curve=PassBand(from_nm=500.0, to_nm=520.0, edge_nm=0.0), band_width_nm=60.0)
    values = mean(np.linspace(400.0, 700.0, 12).reshape(3, 4))
    assert values.shape == (3, 4)
    assert values.min() >= 0.0
    assert values.max() <= 1.0


def test_band_outside_curve_is_rejected():
    with pytest.raises(ParameterError, match=r"must be within the absorption table of silicon"):
        BandMean(curve=SILICON, band_width_nm=20.0)([400.0, 500.0])


@pytest.mark.parametrize(
    ("parameters", "name"),
    [
        ({"curve": 0.5, "band_width_nm": 10.0}, "curve"),
        ({"curve": GREEN, "band_width_nm": 0.0}, "band_width_nm"),
        ({"curve": GREEN, "band_width_nm": 10.0, "n_points": 0}, "n_points"),
    ],
)
def test_invalid_band_mean_is_rejected(parameters, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be"):
        BandMean(**parameters)


def test_band_below_zero_is_rejected():
    with pytest.raises(ParameterError, match=r"^'wavelength_nm' must be > 500, half the band width, got 400.0 nm"):
        BandMean(curve=GREEN, band_width_nm=1000.0)(400.0)


# -- files ------------------------------------------------------------------------------------------------------------


def write_curves(directory, text):
    path = directory / "curves.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "wavelength_nm,qe\n400,0.1\n500,0.6\n700,0.2\n",
        "400,0.1\n500,0.6\n700,0.2",
        "# a comment\n\nnm\tqe\n700\t0.2\n400\t.1\n# another\n500\t6e-1\n",
        "wavelength (nm);qe\r\n400;0.1\r\n500;0.6\r\n700;0.2\r\n",
        "wavelength  QE\n 400   0.1\n 500   0.6\n 700   0.2\n",
        "lambda [µm],qe\n0.4,0.1\n0.5,0.6\n0.7,0.2\n",
        "Wavelength_um,qe\n0.4,0.1\n0.5,0.6\n0.7,0.2\n",
        "wavelength_nm,QE [%]\n400,10\n500,60\n700,20\n",
        "wavelength_nm,qe_percent\n400,10\n500,60\n700,20\n",
        '"wavelength, nm","the qe"\n"400","0.1"\n500,0.6\n700,0.2\n',
        b"\xef\xbb\xbfwavelength_nm,qe\n400,0.1\n500,0.6\n700,0.2\n",
    ],
)
def test_read_curve_accepts_common_formats(tmp_path, text):
    expected = TableCurve(wavelength_nm=[400, 500, 700], value=[0.1, 0.6, 0.2])
    assert read_curve(write_curves(tmp_path, text)) == expected


def test_caller_specifies_units(tmp_path):
    path = write_curves(tmp_path, "0.4,10\n0.7,60\n")
    curve = read_curve(path, wavelength_unit="um", value_unit="percent", between="spline", beyond="hold")
    assert curve == SplineCurve(wavelength_nm=[400, 700], value=[0.1, 0.6], beyond="hold")
    assert curve.source == "curves.csv, 1"


def test_column_is_selected_by_name_or_number(tmp_path):
    path = write_curves(tmp_path, "wavelength_nm,R,G (%)\n400,0.1,50\n500,0.2,60\n")
    assert read_curve(path, "G") == read_curve(path, 2) == TableCurve(wavelength_nm=[400, 500], value=[0.5, 0.6])
    assert read_curve(path, "R", value_unit="percent").value == (0.001, 0.002)


def test_filter_names_are_column_names(tmp_path):
    filters = read_filters(write_curves(tmp_path, "wavelength_nm,R,G [%],B_percent\n400,0.1,50,7\n500,0.2,60,8\n"))
    assert filters.names == ("R", "G", "B")
    np.testing.assert_allclose(filters.transmission(np.array([450.0])), [[0.15], [0.55], [0.075]], rtol=4 * EPS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no table, only comments and empty lines"),
        ("# comment\n\n  \n", "contains no table"),
        ("wavelength_nm,qe\n", "must have at least 2 rows of numbers, got 0"),
        ("400,0.5\n", "must have at least 2 rows of numbers, got 1"),
        ("400\n500\n", "must have 2 to 1000 columns, wavelengths and values, got 1"),
        (",".join(["400"] * 2000) + "\n" + ",".join(["500"] * 2000), "must have 2 to 1000 columns"),
        ("400,0.1\n500\n", "line 2 must have 2 columns, as in the first row, got 1"),
        ("nm,qe\n400,0.1\n500,0.2,\n", "line 3 must have 2 columns, as in the first row, got 3"),
        ("400,0.1\n500,high\n", "line 2, column 2: must be a number, got 'high'"),
        ("400,0.1\n500,\n", "line 2, column 2: must be a number, got ''"),
        ("400,0.1\n500,nan\n", "line 2, column 2: must be a number, got 'nan'"),
        ("nan,0.1\n500,0.2\n", "line 1, column 1: must be a number, got 'nan'"),
        ("400,inf\n500,0.2\n", "line 1, column 2: must be a number, got 'inf'"),
        ("400,0x1\n500,0.2\n", "line 1, column 2: must be a number"),
        ("400,1_0\n500,0.2\n", "line 1, column 2: must be a number"),
        ("400,__import__('os')\n500,0.2\n", "line 1, column 2: must be a number"),
        ("400;0,1\n500;0.2\n", "has decimal points, in line 2, and commas, in line 1; use one decimal mark"),
        ("400;1.000,1\n500;0,2\n", "line 1, column 2: must be a number, got '1.000,1'"),
        ('400,"0.1\n500,0.2\n', "line 1 cannot be split into columns"),
        ("400,0.1\n500,1.2\n", r"line 2, column '1': 1\.2 must be <= 1; for percentages set value_unit='percent'"),
        ("400,0.1\n500,1e999\n", "line 2, column '1': inf must be <= 1"),
        ("nm,QE [%]\n400,10\n500,101\n", "line 3, column 'QE': 101 must be <= 100 %"),
        ("400,0.1\n500,-0.01\n", r"line 2, column '1': -0\.01 must be >= 0; set negative noise to 0"),
        (
            "0.4,0.1\n0.5,0.2\n",
            r"line 1: the wavelength must be from 10 to 1e\+06 nm, got 0\.4; for .* wavelength_unit='um'",
        ),
        ("400,0.1\n-500,0.2\n", "line 2: the wavelength must be from"),
        ("um,qe\n400,0.1\n5000,0.2\n", r"line 3: the wavelength must be .*, got 5e\+06$"),
        ("400,0.1\n500,0.2\n400.0,0.1\n", "lines 1 and 3 have the same wavelength, 400 nm"),
        (
            "wavelength (Angstrom),qe\n4000,0.1\n5000,0.2\n",
            "wavelengths must be in nm or µm, got the column name 'wavelength ",
        ),
        ("nm,R,R\n400,0.1,0.2\n500,0.2,0.2\n", "column 3 repeats the name 'R' in the header"),
        ("nm,R,\n400,0.1,0.2\n500,0.2,0.2\n", "column 3 has no name in the header"),
        ("nm,%\n400,0.1\n500,0.2\n", "column 2 has no name in the header"),
        ("400,0.1\x00\n500,0.2\n", "line 1, column 2: must be a number"),
        (b"\xff\xfe4\x000\x000\x00", "is not valid UTF-8 text"),
        (b"400,0.1\n" * 600_000, "must be a table of curves with at most 4194304 bytes"),
        (b"4,1\n" * 100_001, "must be a table of curves with at most 100000 lines"),
    ],
)
@pytest.mark.parametrize("read", [lambda path: read_curve(path, 1), read_filters], ids=["curve", "filters"])
def test_malformed_curve_file_is_rejected(tmp_path, read, text, message):
    with pytest.raises(FileError, match=rf"curves\.csv: {message}[^\n]*$"):
        read(write_curves(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffWellenlaenge (nm);QE [%];IR [%]\r\n400;10,5;0\r\n500,5;62;1,5\r\n",
        "wavelength_nm;QE [%];IR [%];\n400;10,5;0;\n500,5;62;1,5;\n",
        "wavelength_nm;QE [%];IR [%]\n400;10,5;0;\n500,5;62;1,5;\n",
        "nm\tQE%\tIR%\n400\t10,5\t0\n500,5\t62\t1,5\n",
        "nm,QE%,IR%,\n400,10.5,0,\n500.5,62,1.5,\n,,,\n",
        "nm QE% IR%\n400 10,5 0\n500,5 62 1,5\n",
        "# exported\nnm QE% IR%\n400 10.5 0\n\n500.5 62 1.5\n",
    ],
)
def test_tables_of_spreadsheets_are_read(tmp_path, text):
    (tmp_path / "curves.csv").write_text(text, encoding="utf-8", newline="")
    filters = read_filters(tmp_path / "curves.csv")
    assert filters.names == ("QE", "IR")
    assert [curve.wavelength_nm for curve in filters.curves] == [(400.0, 500.5)] * 2
    assert [curve.value for curve in filters.curves] == [(0.105, 0.62), (0.0, 0.015)]


def test_blanks_and_decimal_commas_without_header(tmp_path):
    (tmp_path / "curves.csv").write_text("400 0,1\n500 0,25\n", encoding="utf-8")
    assert read_curve(tmp_path / "curves.csv").value == (0.1, 0.25)
    (tmp_path / "curves.csv").write_text("400, 0.1\n500, 0.25\n", encoding="utf-8")
    assert read_curve(tmp_path / "curves.csv").value == (0.1, 0.25)


@pytest.mark.parametrize("read", [read_curve, read_filters])
@pytest.mark.parametrize(("name", "message"), [("no.csv", "no such file"), ("", "is not a file"), ("\0", "")])
def test_missing_curve_file_is_rejected(tmp_path, read, name, message):
    with pytest.raises(FileError, match=f"{message}[^\n]*$"):
        read(tmp_path / name)


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (None, "has 2 value columns; specify one of R, G"),
        ("B", "has no column 'B'; possible: 'R', 'G', or 1 to 2"),
        (0, "has no column 0"),
        (3, "has no column 3"),
        (True, "has no column True"),
        (1.0, "has no column 1.0"),
    ],
)
def test_missing_column_is_rejected(tmp_path, column, message):
    with pytest.raises(FileError, match=f"{message}[^\n]*$"):
        read_curve(write_curves(tmp_path, "nm,R,G\n400,0.1,0.2\n500,0.2,0.2\n"), column)


@pytest.mark.parametrize("name", ["wavelength_unit", "value_unit", "between", "beyond"])
def test_invalid_options_are_rejected(tmp_path, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be one of .*, got 'guess'$"):
        read_filters(write_curves(tmp_path, "400,0.1\n500,0.2\n"), **{name: "guess"})


# -- measured curves --------------------------------------------------------------------------------------------------

#: A second CCD of this type, from another ESO report (Grus), and a second D5100 (Jiang et al. 2013), normalised per colour.
GRUS = {
    480: 0.790,
    520: 0.786,
    560: 0.764,
    600: 0.754,
    640: 0.743,
    700: 0.693,
    760: 0.591,
    800: 0.517,
    860: 0.397,
    900: 0.293,
    960: 0.127,
    1000: 0.047,
}
D5100 = {
    450: (0.048, 0.188, 1.000), 480: (0.056, 0.433, 0.901), 500: (0.059, 0.648, 0.583), 530: (0.141, 1.000, 0.162),
    560: (0.047, 0.669, 0.029), 590: (1.000, 0.314, 0.009), 620: (0.620, 0.056, 0.003), 650: (0.277, 0.020, 0.005),
}  # fmt: skip


def test_ccd_agrees_with_second_device():
    np.testing.assert_allclose(ccd_qe()(list(GRUS)), list(GRUS.values()), rtol=0, atol=0.0451)


def test_camera_filters_agree_with_second_camera():
    waves_nm = np.array(list(D5100), float)
    per_energy = camera_filters().transmission(waves_nm) * waves_nm
    dense_nm = np.arange(400.0, 720.0)
    per_energy /= (camera_filters().transmission(dense_nm) * dense_nm).max(axis=1, keepdims=True)
    np.testing.assert_allclose(per_energy.T, list(D5100.values()), rtol=0, atol=0.11)


def test_camera_filters_have_unit_maximum():
    waves_nm = np.arange(380.0, 780.5, 5.0)
    values = camera_filters().transmission(waves_nm)
    np.testing.assert_array_equal(values.max(axis=1), 1.0)
    assert waves_nm[values.argmax(axis=1)].tolist() == [595.0, 530.0, 460.0]
    assert values.min() >= 0.0


# -- settings ---------------------------------------------------------------------------------------------------------

SHOT = """
scene: {kind: flat, shape: [40, 40], pitch_um: 400, distance_m: 1.0, radiance_w_m2_sr_nm: 0.2, band_width_nm: 100}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {generator: grid, parameters: {n_x: 4, n_y: 4, pitch_um: 8}, mosaic: [RG, GB]}
exposure_s: 0.01
"""


@pytest.fixture
def shot_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # overrides refer to files in the working directory
    (tmp_path / "curves.csv").write_text("wavelength_nm,R,G [%],B\n400,0.1,50,0.7\n700,0.2,60,0.8\n")
    path = tmp_path / "shot.yaml"
    path.write_text(SHOT)
    return path


@pytest.mark.parametrize(
    ("setting", "curve"),
    [
        ("{kind: ccd}", ccd_qe()),
        ("{kind: pass_band, to_nm: 650, edge_nm: 20}", PassBand(to_nm=650.0, edge_nm=20.0)),
        ("{kind: table, wavelength_nm: [400, 700], value: [0.2, 1]}", TableCurve(wavelength_nm=[400, 700], value=[0.2, 1])),
        ("{kind: spline, wavelength_nm: [400, 700], value: [0, 1]}", SplineCurve(wavelength_nm=[400, 700], value=[0, 1])),
        ("{kind: step, edge_nm: [400, 700], value: [0.5], beyond: hold}", StepCurve(edge_nm=[400, 700], value=[0.5], beyond="hold")),
        ("{kind: product, curves: [0.9, {kind: silicon, depth_um: 3}]}", ProductCurve([0.9, SILICON])),
        ("{kind: file, path: curves.csv, column: G}", TableCurve(wavelength_nm=[400, 700], value=[0.5, 0.6])),
        ("{kind: file, path: curves.csv, column: 1, between: spline}", SplineCurve(wavelength_nm=[400, 700], value=[0.1, 0.2])),
    ],
)  # fmt: skip
def test_settings_curve_matches_constructor(shot_file, setting, curve):
    assert read_shot(shot_file, [f"sensor.qe={setting}"]).camera.sensor.qe == curve


def test_settings_filter_path_is_relative(shot_file, tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    shot_file.write_text(SHOT + "sensor: {filters: {path: curves.csv}}\n")
    sensor = read_shot(shot_file).camera.sensor
    assert sensor.filters == read_filters(tmp_path / "curves.csv")
    assert sensor.filter_names == ("R", "G", "B")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("sensor.qe={kind: file, path: no.csv}", r"sensor\.qe: .*no\.csv: no such file"),
        ("sensor.qe={kind: file, path: curves.csv}", r"sensor\.qe: .*has 3 value columns; specify one of R, G, B"),
        ("sensor.qe={kind: product, curves: [{kind: step}]}", r"sensor\.qe\.curves\.0\.edge_nm: missing"),
        ("sensor.qe={kind: product, curves: [2]}", r"sensor\.qe\.curves: must be <= 1, got 2"),
        ("sensor.filters={path: shot.yaml}", r"sensor\.filters: .*shot\.yaml: "),
        ("sensor.filters={path: curves.csv, names: [a]}", r"sensor\.filters\.names: unknown (key|parameter)"),
        ("sensor.filters={curves: [{kind: file, path: no.csv}]}", r"sensor\.filters\.curves\[0\]: .*no such file"),
    ],
)
def test_invalid_settings_curve_error_names_key(shot_file, change, message):
    with pytest.raises(ConfigError, match=message):
        read_shot(shot_file, [change])
