"""Shot noise: one Poisson draw of the expected charge, photoelectrons plus dark signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from foveasim._core.random_streams import Streams, standard_normal
from foveasim._core.validation import Floats, Ints, unmasked
from foveasim.sensor.blocks import for_each_block, pieces
from foveasim.sensor.effects.contract import Effect, Sites, Stage

__all__ = ["MAX_CHARGE_E", "ShotChoice", "ShotNoise", "draw_shot_noise"]

ShotChoice = Literal["auto", "exact", "off"]

#: Limit of numpy's Poisson generator. Larger expectations are rounded: their relative shot noise is below 1e-9.
MAX_EXACT_E = 1e18
#: Upper limit of charges: 2**62 fits int64 with headroom for sums.
MAX_CHARGE_E = 2.0**62
#: Variance of rounding to integers.
ROUNDING_E2 = 1.0 / 12.0


@dataclass(frozen=True)
class ShotNoise(Effect):
    """
    Shot-noise draw from expected to collected charge, in whole electrons.

    Parameters
    ----------
    how : {"auto", "exact", "off"}
        ``"auto"``: exact Poisson draws for expectations up to ``gaussian_above_e``; above it, a rounded quadratic function of
        a Gaussian number with the mean, variance and third central moment of the Poisson distribution. A site's draw does not
        depend on the expectations of other sites. ``"exact"``: Poisson draws everywhere. ``"off"``: the rounded expectation.
    gaussian_above_e : float, e-

    Notes
    -----
    A Poisson distribution of mean λ has variance λ and third central moment λ. With a standard normal z, the random variable
    ``λ + s z + c (z² - 1)`` has mean λ, variance ``s² + 2 c²`` and third central moment ``6 c s² + 8 c³``; rounding adds 1/12
    to the variance. Hence ``s² = λ - 1/12 - 2 c²``, and c solves ``6 c (λ - 1/12) - 4 c³ = λ``: to order 1/λ it is
    ``1/6 + 11 / (648 λ)``. This is the second-order Cornish-Fisher expansion (Abramowitz and Stegun, 26.2.49), corrected for
    rounding.
    """

    name: ClassVar[str] = "shot"
    stage: ClassVar[Stage] = "collection"
    is_temporal: ClassVar[bool] = True

    how: ShotChoice = "auto"
    gaussian_above_e: float = 100.0

    @property
    def is_drawn(self) -> bool:
        """Whether charges are drawn, rather than only rounded."""
        return self.how != "off"

    def apply(self, values: Floats, *, sites: Sites | None, rng: np.random.Generator) -> Any:
        """Return the drawn charges, (n,) int64 e-."""
        from foveasim.sensor import _kernels

        _ = sites
        if self.how == "off":
            return np.rint(np.clip(values, 0.0, MAX_CHARGE_E)).astype(np.int64)
        if self.how == "auto":
            electrons = np.empty(values.size, np.int64)
            _kernels.draw_poisson(values, standard_normal(rng, values.size), self.gaussian_above_e, electrons)
            return electrons
        is_beyond = values > MAX_EXACT_E
        electrons = rng.poisson(np.where(is_beyond, 0.0, values))
        electrons[is_beyond] = np.rint(np.minimum(values[is_beyond], MAX_CHARGE_E)).astype(np.int64)
        return electrons

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites | None = None) -> tuple[Floats, Floats]:
        """Return the mean, and the variance plus shot noise, or plus rounding if not drawn."""
        _ = sites
        return mean, variance + (np.maximum(mean, 0.0) if self.is_drawn else ROUNDING_E2)


def draw_shot_noise(
    expected_e: Floats, how: ShotChoice, gaussian_above_e: float, streams: Streams, *, n_threads: int | None = None
) -> Ints:
    """
    Draw collected charges from expected ones.

    Parameters
    ----------
    expected_e : (n_site,) float64, e-
    how, gaussian_above_e
        See :class:`foveasim.sensor.effects.ShotNoise`.
    streams : Streams
        Random streams of the frame; the stream ``shot`` is used.
    n_threads : int, optional
        Number of threads; all cores by default. Draws do not depend on it.

    Returns
    -------
    electrons : (n_site,) int64, e-
        Non-negative.
    """
    expected_e = np.ascontiguousarray(unmasked("expected_e", expected_e), np.float64)
    shot = ShotNoise(how, gaussian_above_e)
    electrons = np.empty(expected_e.size, np.int64)

    def block(number: int, sites: slice) -> None:
        rng = streams.of(shot.name, number)
        for piece in pieces(sites):
            electrons[piece] = shot.apply(expected_e[piece], sites=None, rng=rng)

    for_each_block(expected_e.size, block, n_threads)
    return electrons
