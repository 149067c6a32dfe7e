"""The sensor: from watts on its photosites to digital codes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from foveasim.arrays import Floats, Ints, check_choice, check_count, check_number, finite_array, read_only
from foveasim.errors import ParameterError, SimulationError
from foveasim.fields import PackedRings
from foveasim.sensor.noise import LARGEST_CHARGE_E, ShotNoise, draw_shot_noise
from foveasim.sensor.spectral import ConstantCurve, Curve, FilterSet, rgb_filters
from foveasim.streams import Streams
from foveasim.units import electrons_to_volts, photon_energy_j

__all__ = ["PerSite", "Photosites", "Sensor"]

#: Capacitances outside this range are a slip of units.
MIN_CAPACITANCE_F, MAX_CAPACITANCE_F = 1e-18, 1e-6
#: A charge this share of a code below a code's border is on it: the rounding of a division.
CODE_ROUNDING = 1e-9

#: One value for all sites, or an array (n_site,).
PerSite = float | NDArray[np.float64]


class Photosites(PackedRings, Protocol):
    """Outlines with a colour channel per site, as the sensor needs them; :class:`foveasim.Layout` is one."""

    @property
    def n_sites(self) -> int:
        """Number of sites."""

    @property
    def channel(self) -> Ints:
        """Index of each site's colour filter, (n_site,)."""

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Data per site by name; ``channel`` is among them where sites differ in colour."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """
    Photosites with their electronics.

    The order of effects: expected photons x quantum efficiency x filter, + dark charge, **one** Poisson draw, full
    well, + read noise, volts (q/C), clip to 0 .. V_sat, ADC. The defaults are a perfect sensor: every photon an
    electron, no noise but the shot noise of light.

    Parameters
    ----------
    layout : Layout
        The photosites; their ``channel`` chooses the filter.
    qe : float or curve
        Quantum efficiency, electrons per photon: a number, or a function of the wavelength in nm, such as
        :class:`SiliconQE` or :class:`PolynomialCurve`.
    filters : None, "rgb", or FilterSet
        Colour filters; None for a sensor without, whatever the layout's channels, "rgb" for :func:`rgb_filters`.
    dark_e_per_s : float or (n_site,), e-/s
        Dark current.
    full_well_e : float or (n_site,), optional, e-
        Charge that a site can hold; None for no limit but V_sat.
    read_noise_e : float or (n_site,), e-
        Standard deviation of the Gaussian noise of reading.
    capacitance_f : float or (n_site,), F
        Capacitance that the charge is read on: 1e-13 F in the paper's foveal run.
    v_sat_v : float, V
        Voltage that gives the highest code; nothing above it is seen.
    bits : int
        Of the linear analogue-to-digital converter, 1 to 16.
    shot_noise : {"auto", "exact", "off"}
        See :func:`foveasim.sensor.draw_shot_noise`.
    gaussian_above_e : float, e-
        Expectation above which ``"auto"`` takes the Gaussian for the Poisson law.

    Raises
    ------
    ParameterError
        When a value is out of range, or an array does not have one value a site.
    SimulationError
        When the layout's channels need more filters than there are.
    """

    layout: Photosites
    _: KW_ONLY
    qe: float | Curve = 1.0
    filters: FilterSet | Literal["rgb"] | None = None
    dark_e_per_s: PerSite = 0.0
    full_well_e: PerSite | None = None
    read_noise_e: PerSite = 0.0
    capacitance_f: PerSite = 1e-13
    v_sat_v: float = 3.0
    bits: int = 8
    shot_noise: ShotNoise = "auto"
    gaussian_above_e: float = 100.0

    def __post_init__(self) -> None:
        if not all(hasattr(self.layout, name) for name in ("n_sites", "channel", "columns")):
            raise ParameterError("layout", f"must be a Layout, got a {type(self.layout).__name__}")
        if not callable(self.qe):
            object.__setattr__(self, "qe", check_number("qe", self.qe, at_least=0.0, at_most=1.0))
        is_rgb = isinstance(self.filters, str) and self.filters == "rgb"
        if self.filters is not None and not is_rgb and not isinstance(self.filters, FilterSet):
            raise ParameterError("filters", "must be None, 'rgb' or a FilterSet", self.filters)
        for name, above in (
            ("dark_e_per_s", None),
            ("full_well_e", 0.0),
            ("read_noise_e", None),
            ("capacitance_f", 0.0),
        ):
            value = getattr(self, name)
            if value is not None or name != "full_well_e":
                object.__setattr__(self, name, self._per_site(name, value, above))
        if not np.all(
            (np.asarray(self.capacitance_f) >= MIN_CAPACITANCE_F)
            & (np.asarray(self.capacitance_f) <= MAX_CAPACITANCE_F)
        ):
            raise ParameterError(
                "capacitance_f",
                f"must be from {MIN_CAPACITANCE_F:g} to {MAX_CAPACITANCE_F:g}",
                self.capacitance_f,
                "F",
                "capacitances are in farad: 1 fF is 1e-15",
            )
        object.__setattr__(self, "v_sat_v", check_number("v_sat_v", self.v_sat_v, above=0.0))
        object.__setattr__(self, "bits", check_count("bits", self.bits, at_least=1, at_most=16))
        check_choice("shot_noise", self.shot_noise, ("auto", "exact", "off"))
        object.__setattr__(
            self, "gaussian_above_e", check_number("gaussian_above_e", self.gaussian_above_e, at_least=10.0)
        )
        if self.filters is None:
            return
        if self.n_filters > 1 and "channel" not in self.layout.columns:
            raise SimulationError(
                f"the sensor has {self.n_filters} filters, but the layout does not say which site has which; give it a column "
                "'channel', for example with foveasim.layout.mosaic(layout, ('RG', 'GB'))"
            )
        highest = int(self.layout.channel.max(initial=0))
        if highest >= self.n_filters:
            raise SimulationError(
                f"the layout has sites of channel {highest}, but the sensor only the filters 0 to {self.n_filters - 1} "
                f"({', '.join(self.filter_names)})"
            )

    def __repr__(self) -> str:
        return f"Sensor({self.layout!r}, filters {', '.join(self.filter_names)}, {self.bits} bits)"

    def _per_site(self, name: str, value: PerSite, above: float | None) -> PerSite:
        if np.ndim(value) == 0:
            return check_number(name, value, above=above, at_least=0.0)
        array = finite_array(name, value, ndim=1, above=above, at_least=0.0)
        if array.size != self.layout.n_sites:
            raise ParameterError(
                name, f"must be one number, or one for each of the {self.layout.n_sites} sites, got {array.size}"
            )
        return read_only(array.copy())

    # -- colour -------------------------------------------------------------------------------------------------

    @property
    def _filter_set(self) -> FilterSet:
        if self.filters is None:
            return FilterSet((ConstantCurve(1.0),), ("all",))
        return rgb_filters() if isinstance(self.filters, str) else self.filters

    @property
    def n_filters(self) -> int:
        """Number of different colour filters; 1 for a sensor without."""
        return len(self._filter_set)

    @property
    def filter_names(self) -> tuple[str, ...]:
        """The filters' names."""
        return tuple(self._filter_set.names or ())

    @property
    def filter_of_site(self) -> Ints:
        """Index of each site's filter, (n_site,)."""
        return np.zeros(self.layout.n_sites, np.int64) if self.filters is None else self.layout.channel

    def responsivity_e_per_j(self, wavelength_nm: Floats) -> Floats:
        """
        Electrons per joule of light that falls on a site.

        Parameters
        ----------
        wavelength_nm : (n_wavelength,) float64, nm

        Returns
        -------
        responsivity : (n_filter, n_wavelength) float64, e-/J
            ``qe * filter * wavelength / (h c)``.

        Raises
        ------
        ParameterError
            When a quantum efficiency or a filter leaves 0 .. 1, or is not known at a wavelength.
        """
        qe = self.qe(wavelength_nm) if callable(self.qe) else np.full(wavelength_nm.shape, float(self.qe))
        curves = np.broadcast_to(qe, wavelength_nm.shape) * self._filter_set.transmission(wavelength_nm)
        if not (np.isfinite(curves).all() and curves.min() >= 0.0 and curves.max() <= 1.0):
            raise ParameterError("qe", "and the filters must give values from 0 to 1 at every wavelength", curves)
        return curves / photon_energy_j(wavelength_nm)

    # -- charge and code ------------------------------------------------------------------------------------------

    def expected_electrons(self, photo_e_per_s: Floats, exposure_s: float) -> Floats:
        """
        Expected charge of every site at the end of an exposure, (n_site,) e-: photoelectrons and dark charge.

        Raises
        ------
        ParameterError
            When the exposure is negative.
        """
        exposure_s = check_number("exposure_s", exposure_s, at_least=0.0)
        return (photo_e_per_s + self.dark_e_per_s) * exposure_s

    def collect(self, expected_e: Floats, *, streams: Streams) -> Ints:
        """Charge that a draw gives, (n_site,) int64 e-: shot noise, then the full well."""
        electrons = draw_shot_noise(expected_e, self.shot_noise, self.gaussian_above_e, streams)
        if self.full_well_e is None:
            return electrons
        return np.minimum(electrons, np.floor(np.minimum(self.full_well_e, LARGEST_CHARGE_E)).astype(np.int64))

    def read(self, electrons: Ints, *, streams: Streams) -> NDArray[Any]:
        """
        Digital code of every charge, (n_site,) uint8 or uint16.

        Read noise, volts, the clip at V_sat and the converter: code ``k`` stands for the voltages from
        ``k * V_sat / 2**bits`` to the next, and both 0 and ``2**bits - 1`` are reached.
        """
        charge_e = electrons.astype(np.float64)
        if np.any(np.asarray(self.read_noise_e) > 0.0):
            charge_e += self.read_noise_e * streams.of("read").standard_normal(charge_e.size)
        voltage_v = np.clip(electrons_to_volts(charge_e, self.capacitance_f), 0.0, self.v_sat_v)
        n_codes = 2**self.bits
        code = np.minimum(np.floor(voltage_v * (n_codes / self.v_sat_v) + CODE_ROUNDING), n_codes - 1)
        return code.astype(np.uint8 if self.bits <= 8 else np.uint16)
