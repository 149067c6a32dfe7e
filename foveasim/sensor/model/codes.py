"""Prediction of codes: their moments for every site, and their covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, read_only
from foveasim.sensor.blocks import for_each_block
from foveasim.sensor.effects import Sites
from foveasim.sensor.effects.contract import NOTHING
from foveasim.sensor.effects.shot import ShotNoise
from foveasim.sensor.model.linearisation import QUANTISATION
from foveasim.sensor.model.prediction import (
    NO_TABLES,
    ChargeDistributions,
    ChargeTables,
    Transfer,
    clipped_gaussian_moments,
)

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

#: Offset of voltages for the slope of mean codes, in standard deviations of the noise: the error is below 1e-3; and smallest
#: noise to which it is relative, in units of the range.
OFFSET_SIGMAS, SMALLEST_NOISE = 0.05, 1e-9
#: Fraction of its own charge that a site keeps in a mixing, above which this charge has its own distribution in predictions.
MIN_OWN_FRACTION = 0.5


def predict(
    sensor: Sensor,
    expected_e: Floats,
    sites: Sites,
    offset_v: Floats | float = 0.0,
    *,
    n_threads: int | None = None,
) -> tuple[Floats, Floats]:
    """
    Return mean and variance of the codes, DN and DN²; see :meth:`foveasim.Sensor.predict`.

    ``offset_v`` is added to the voltages at the ADC.
    """
    from foveasim.sensor import _kernels

    mean_dn, variance_dn2 = np.empty(expected_e.size), np.empty(expected_e.size)
    well_e, collection = sensor.well_e, sensor.collection
    line, tables_of_adc = sensor.conversion_tables
    is_drawn, is_poisson = collection.is_drawn, isinstance(collection, ShotNoise)
    drawn_e, drawn_e2 = collection.validate_moments(expected_e, NOTHING, sites)
    if not is_drawn:
        drawn_e, drawn_e2 = np.minimum(np.rint(drawn_e), well_e), np.zeros(1)
    collected_e, collected_e2 = clipped_gaussian_moments(drawn_e, drawn_e2, well_e)
    model = sensor.readout_model(collected_e, collected_e2)
    transfer, noise_e2, half_step_e = model.transfer, model.gaussian_e2, model.half_step_e
    own = model.own_fraction
    if own is not None and own.size and own.min() > MIN_OWN_FRACTION:
        # The own charge has its distribution; charges of other sites are Gaussian.
        others_e = model.mean_e - own * collected_e
        others_e2 = np.maximum(model.variance_e2 - own**2 * collected_e2, 0.0)
        transfer = transfer._replace(
            v_per_e=transfer.v_per_e * own, sense_v=transfer.sense_v + transfer.v_per_e * others_e
        )
        noise_e2, half_step_e = (noise_e2 + others_e2) / own**2, half_step_e / own
    elif model.is_mixed:
        # Mixed charges, after clipping at the full well, are approximated as Gaussian.
        drawn_e, drawn_e2 = model.mean_e, model.variance_e2
        is_drawn, well_e = False, np.array([np.inf])
    charges = ChargeDistributions(
        mean_e=drawn_e,
        variance_e2=drawn_e2,
        well_e=well_e,
        sigma_e=np.sqrt(noise_e2),
        half_step_e=half_step_e,
        is_drawn=is_drawn,
    )
    transfer = transfer._replace(output_v=np.asarray(transfer.output_v + offset_v))

    def block(_: int, index: slice) -> None:
        chosen = sites.block(index)

        def part(values: Any) -> Any:
            return read_only(chosen.select(values).view()) if isinstance(values, np.ndarray) else values

        tables = NO_TABLES
        if is_drawn and not is_poisson:
            first, probability, offsets = collection.table(expected_e[index], sites=chosen.of(collection))
            tables = ChargeTables(*map(read_only, (first, offsets, probability)))
        _kernels.predict_codes(
            ChargeDistributions(*map(part, charges)),
            tables,
            Transfer(*map(part, transfer)),
            part(line),
            tables_of_adc,
            mean_dn[index],
            variance_dn2[index],
        )

    for_each_block(expected_e.size, block, n_threads)
    return mean_dn, variance_dn2


def predict_covariance(
    sensor: Sensor, charge_e: Floats, chosen: ArrayLike, during: Sites, exposure_s: float | None
) -> Floats:
    """Return the covariance of codes, DN²; see :meth:`foveasim.Sensor.predict_covariance`."""
    model = sensor.linearise(charge_e, exposure_s=exposure_s)
    covariance = model.covariance_matrix_dn2(chosen)
    index = np.asarray(chosen)
    # The mean code for small offsets of the voltage at the ADC.
    before = [name for name, kind in model.sources.items() if kind != "fixed" and name != QUANTISATION]
    noise_v = np.sqrt(model.variance_dn2(before)) / model.slope_dn_per_v
    offset_v = OFFSET_SIGMAS * np.broadcast_to(np.maximum(noise_v, SMALLEST_NOISE * sensor.v_sat_v), charge_e.shape)
    (ahead_dn, _), (behind_dn, _) = (predict(sensor, charge_e, during, each) for each in (offset_v, -offset_v))
    smooth = ((ahead_dn - behind_dn) / (2.0 * offset_v * model.slope_dn_per_v))[index]
    covariance *= np.multiply.outer(smooth, smooth)
    np.fill_diagonal(covariance, predict(sensor, charge_e, during)[1][index])
    return covariance
