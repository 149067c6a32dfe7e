"""
Plausible ranges that several parameters of sensors and exposures share.

Values outside these ranges indicate errors of units or digits. The ranges are wide: no sensor in use reaches their limits.
"""

from __future__ import annotations

from dataclasses import replace

from foveasim._core.calls import FRACTION, Limits

_ELECTRONS = "charges are in electrons: 1 fC is 6242 e-"
_SECONDS = "times are in seconds: 1 ms is 1e-3"

SHARE = replace(FRACTION, hint="fractions are from 0 to 1")
#: Relative standard deviation of Gaussian factors: 1 in 2,300 values is then below 0 and clipped.
SPREAD = Limits(
    at_least=0.0,
    at_most=0.3,
    hint="0.03 is 3 %; a Gaussian distribution with a standard deviation above 0.3 would be clipped at 0",
)
#: Relative standard deviation of log-normal distributions.
WIDE_SPREAD = Limits(
    at_least=0.0, at_most=10.0, hint="the value is the ratio of standard deviation to mean: 0.1 is 10 %"
)
OFFSET = Limits(at_least=0.0, at_most=1.0, hint="offsets are fractions of v_sat_v: 0.02 is 2 %")
RATE = Limits(at_least=0.0, at_most=1e15, hint="rates are in electrons per second: 1 fA is 6242 e-/s")
CHARGE = Limits(above=0.0, at_most=1e15, hint=_ELECTRONS)
#: System gain K of a linear ADC.
GAIN = Limits(above=0.0, low=1e-9, at_most=1e6, hint="K is in DN/e-; its inverse is in e-/DN")
#: For comparison: the reset noise of a microfarad at room temperature is 4e5 e-.
NOISE = Limits(at_least=0.0, at_most=1e7, hint=_ELECTRONS)
TEMPERATURE = Limits(above=0.0, low=0.01, at_most=1000.0, hint="temperatures are in kelvin: 0 °C is 273.15 K")
VOLTS = Limits(at_least=0.0, at_most=1e3, hint="voltages are in volts: 1 mV is 1e-3")
EXPOSURE = Limits(at_least=0.0, low=1e-12, at_most=1e7, hint=_SECONDS)
DURATION = Limits(above=0.0, low=1e-12, at_most=1e7, hint=_SECONDS)
#: Parameters of a sensor that specify one quantity in two units: at most one of each pair is given.
ALTERNATIVES = (("capacitance_f", "gain_dn_per_e"), ("pixel_fpn_fraction", "dsnu_e"))
#: Frames that are simulated or averaged.
FRAMES = Limits(at_least=1, at_most=10_000_000)
#: Thresholds in standard deviations, and ratios of them.
RATIO = Limits(above=0.0, at_most=1e6, hint="a number of standard deviations")
