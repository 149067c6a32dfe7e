"""Quantum efficiencies and colour filters against Beer and Lambert's law, hand-made tables and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from foveasim.errors import ParameterError
from foveasim.sensor import ConstantCurve, FilterSet, GaussianCurve, PolynomialCurve, SiliconQE, rgb_filters

EPS = np.finfo(float).eps

#: Absorption lengths of silicon as published, nm to µm.
ABSORPTION_UM = {400: 0.0971, 500: 0.8195, 550: 1.561, 650: 3.580, 800: 12.09, 1000: 162.3, 1050: 640.7}


# -- silicon --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("wavelength_nm", "length_um"), ABSORPTION_UM.items())
def test_silicon_one_absorption_length_thick_absorbs_63_percent(wavelength_nm, length_um):
    assert math.isclose(SiliconQE(depth_um=length_um)(wavelength_nm), 0.6321205588285577, rel_tol=4 * EPS)


@pytest.mark.parametrize(
    ("wavelength_nm", "depth_um", "by_hand"),
    [
        (400, 0.05, 0.4024594),  # 1 - exp(-0.5149331)
        (550, 3.0, 0.8536633),  # 1 - exp(-1.9218450)
        (650, 3.0, 0.5674204),  # 1 - exp(-0.8379888)
        (1000, 10.0, 0.0597545),  # 1 - exp(-0.0616143)
    ],
)
def test_silicon_absorbs_what_beer_and_lambert_give_by_hand(wavelength_nm, depth_um, by_hand):
    assert abs(SiliconQE(depth_um=depth_um)(wavelength_nm) - by_hand) < 5e-7


@pytest.mark.parametrize("wavelength_nm", [400.0, 437.0, 620.0, 999.0, 1050.0])
def test_two_layers_pass_the_product_of_what_each_passes(wavelength_nm):
    one, two = (1.0 - SiliconQE(depth_um=d)(wavelength_nm) for d in (1.3, 2.6))
    assert abs(two - one**2) < 4 * EPS


@pytest.mark.parametrize("transmission", [0.3, 0.7, 1.0])
def test_thick_silicon_absorbs_all_that_enters(transmission):
    wavelength_nm = np.linspace(400, 1050, 27)
    np.testing.assert_allclose(
        SiliconQE(depth_um=1e5, transmission=transmission)(wavelength_nm), transmission, rtol=4 * EPS
    )


@pytest.mark.parametrize(("wavelength_nm", "length_um"), ABSORPTION_UM.items())
def test_thin_silicon_absorbs_its_thickness_over_the_absorption_length(wavelength_nm, length_um):
    depth_um = 1e-9  # the next term of the series is smaller by depth / (2 length)
    assert math.isclose(SiliconQE(depth_um=depth_um)(wavelength_nm), depth_um / length_um, rel_tol=1e-7)


def test_silicon_absorbs_less_the_longer_the_wavelength():
    assert np.all(np.diff(SiliconQE(depth_um=3.0)(np.arange(400.0, 1051.0))) < 0.0)


def test_silicon_between_two_wavelengths_of_the_table_has_the_geometric_mean_length():
    absorbed = SiliconQE(depth_um=1.0)(525.0)
    assert math.isclose(-1.0 / math.log(1.0 - absorbed), math.sqrt(0.8195 * 1.561), rel_tol=1e-12)


@pytest.mark.parametrize("outside_nm", [399.9, 300.0, 1050.1, math.inf, -math.inf])
def test_silicon_outside_its_table_is_refused_with_the_wavelength(outside_nm):
    with pytest.raises(ParameterError, match=rf"must lie in .*silicon.*400 to 1050 nm, got {outside_nm} nm$"):
        SiliconQE(depth_um=3.0)([500.0, outside_nm])


@pytest.mark.parametrize(
    "curve",
    [SiliconQE(depth_um=3.0), PolynomialCurve(wavelength_nm=[400, 500], value=[0.1, 0.2], degree=1)],
    ids=["silicon", "polynomial"],
)
def test_a_wavelength_that_is_no_number_is_refused(curve):
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
def test_impossible_silicon_is_refused(parameters, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be"):
        SiliconQE(**parameters)


# -- polynomials ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 5])
def test_a_polynomial_table_is_reproduced_by_a_fit_of_its_degree(degree):
    def truth(wavelength_nm):
        u = (np.asarray(wavelength_nm) - 400.0) / 600.0
        return sum(0.15 * (-u) ** k for k in range(degree + 1)) + 0.3

    table_nm = np.linspace(400.0, 1000.0, 13)
    curve = PolynomialCurve(wavelength_nm=table_nm, value=truth(table_nm), degree=degree)
    between_nm = np.linspace(400.0, 1000.0, 101)
    np.testing.assert_allclose(curve(between_nm), truth(between_nm), rtol=0, atol=1e-13)


def test_a_fit_of_the_highest_degree_goes_through_every_value():
    table_nm, values = [400.0, 450.0, 600.0, 650.0, 700.0], [0.2, 0.5, 0.4, 0.6, 0.1]
    np.testing.assert_allclose(
        PolynomialCurve(wavelength_nm=table_nm, value=values, degree=4)(table_nm), values, rtol=0, atol=1e-12
    )


def test_a_fit_of_degree_zero_is_the_mean():
    assert math.isclose(PolynomialCurve(wavelength_nm=[400, 500, 900], value=[0.1, 0.2, 0.6], degree=0)(444.0), 0.3)


def test_a_fit_of_lower_degree_leaves_errors_orthogonal_to_its_powers():
    rng = np.random.default_rng(3)
    table_nm, values = np.linspace(400.0, 900.0, 21), rng.uniform(0.2, 0.8, 21)
    left_over = values - PolynomialCurve(wavelength_nm=table_nm, value=values, degree=2)(table_nm)
    powers = np.vander((table_nm - 650.0) / 250.0, 3)
    np.testing.assert_allclose(left_over @ powers, 0.0, atol=1e-13)


def test_the_order_of_a_table_does_not_matter():
    table_nm, values = np.array([400.0, 500.0, 600.0, 700.0]), np.array([0.1, 0.5, 0.6, 0.2])
    shuffled = np.array([2, 0, 3, 1])
    curves = [
        PolynomialCurve(wavelength_nm=table_nm[order], value=values[order], degree=2)
        for order in (slice(None), shuffled)
    ]
    np.testing.assert_allclose(curves[0](550.0), curves[1](550.0), rtol=1e-13)


def test_a_fit_that_overshoots_is_held_between_0_and_1():
    curve = PolynomialCurve(wavelength_nm=[400, 500, 600, 700], value=[1.0, 0.0, 0.0, 1.0], degree=2)
    between = curve(np.linspace(400, 700, 301))
    # The parabola through the first, the last and the mean of the middle values dips to -0.125.
    assert between.min() == 0.0
    assert between.max() <= 1.0


def test_a_whole_number_of_any_type_is_a_degree():
    curves = [
        PolynomialCurve(wavelength_nm=[400, 500, 600], value=[0.1, 0.4, 0.2], degree=degree)
        for degree in (2, np.int64(2), 2.0)
    ]
    assert all(a(555.0) == b(555.0) for a, b in itertools.pairwise(curves))


@pytest.mark.parametrize("outside_nm", [399.0, 701.0, math.inf])
def test_a_polynomial_outside_its_table_is_refused_with_the_wavelength(outside_nm):
    curve = PolynomialCurve(wavelength_nm=[700, 400, 500], value=[0.1, 0.2, 0.3], degree=1)
    with pytest.raises(ParameterError, match=rf"must lie in the table .*400 to 700 nm, got {outside_nm} nm$"):
        curve(outside_nm)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"wavelength_nm": [400, 500]}, "'value' must have as many values as 'wavelength_nm'"),
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
        ({"degree": 1.5}, "'degree' must be a whole number"),
    ],
)
def test_a_bad_table_is_refused_in_one_sentence(changed, sentence):
    table = {"wavelength_nm": [400, 500, 600], "value": [0.1, 0.2, 0.3], "degree": 1} | changed
    with pytest.raises(ParameterError, match=f"^{sentence}[^\n]*$"):
        PolynomialCurve(**table)


# -- other curves ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 0.35, 1.0])
def test_a_constant_is_the_same_at_every_wavelength(value):
    assert np.all(ConstantCurve(value)(np.array([1.0, 550.0, 1e6])) == value)


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, "1", None])
def test_a_constant_beyond_0_to_1_is_refused(value):
    with pytest.raises(ParameterError, match=r"^'value' must be"):
        ConstantCurve(value)


def test_a_gaussian_has_half_its_peak_half_its_width_away():
    curve = GaussianCurve(centre_nm=540.0, fwhm_nm=90.0, peak=0.8)
    np.testing.assert_allclose(curve([495.0, 540.0, 585.0]), [0.4, 0.8, 0.4], rtol=4 * EPS)


def test_a_gaussian_of_unit_peak_has_the_area_of_1_0645_widths():
    wavelength_nm = np.arange(100.0, 1000.0)
    # sqrt(pi / (4 ln 2)) = 1.06446701943; the trapezoidal rule is exact to rounding for a Gaussian this wide
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
def test_an_impossible_gaussian_is_refused(changed, name):
    with pytest.raises(ParameterError, match=f"^'{name}' must be"):
        GaussianCurve(**({"centre_nm": 540.0, "fwhm_nm": 90.0} | changed))


def test_filters_keep_their_order():
    filters = FilterSet([ConstantCurve(0.2), ConstantCurve(0.7)], ["dark", "light"])
    np.testing.assert_array_equal(filters.transmission(np.array([500.0, 600.0])), [[0.2, 0.2], [0.7, 0.7]])


def test_filters_without_names_are_numbered():
    assert FilterSet([ConstantCurve()] * 3).names == ("0", "1", "2")


@pytest.mark.parametrize(("wavelength_nm", "winner"), [(620.0, "R"), (550.0, "G"), (450.0, "B")])
def test_each_primary_passes_its_own_filter_best(wavelength_nm, winner):
    filters = rgb_filters()
    assert filters.names[int(np.argmax(filters.transmission(np.array([wavelength_nm]))))] == winner


@pytest.mark.parametrize(
    ("curves", "names", "sentence"),
    [
        ([], None, "'curves' must be one or more functions of wavelength"),
        ([0.5], None, "'curves' must be one or more functions of wavelength"),
        ("ab", None, "'curves' must be one or more functions of wavelength"),
        ([ConstantCurve()], ["a", "b"], "'names' must have one name for each of the 1 curves"),
    ],
)
def test_impossible_filters_are_refused(curves, names, sentence):
    with pytest.raises(ParameterError, match=f"^{sentence}"):
        FilterSet(curves, names)
