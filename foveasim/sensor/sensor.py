"""The sensor: from watts on its photosites to digital codes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats, Ints, check_choice, check_count, check_number, read_only, unmasked
from foveasim.errors import ParameterError, SimulationError
from foveasim.fields import PackedRings
from foveasim.sensor.adc import Companding, Converter
from foveasim.sensor.crosstalk import Coupling, Diffusion, KernelCrosstalk, Mixing, Neighbourhood
from foveasim.sensor.device import Device
from foveasim.sensor.limits import LIMITS, check_plausible, check_plausible_array
from foveasim.sensor.noise import LARGEST_CHARGE_E, ShotNoise, draw_shot_noise, in_blocks, pieces
from foveasim.sensor.spectral.curves import CurveError
from foveasim.sensor.spectral.response import ConstantCurve, Curve, FilterSet, rgb_filters
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C, electrons_to_volts, photon_energy_j

if TYPE_CHECKING:
    from foveasim.sensor.calibration import Calibration

__all__ = ["PerSite", "Photosites", "Sensor"]

#: Points of the quadrature over a charge that the full well cuts off.
QUADRATURE_NODES = 96
#: Means that are drawn by Poisson's law one electron after the other: more take too long.
MOST_INVERTED_E = 700.0
NO_SITES = read_only(np.zeros(0, np.int64))
#: Parameters with one value for all sites or one per site, and those with one value.
_PER_SITE = ("sensitivity", "dark_e_per_s", "full_well_e", "read_noise_e", "capacitance_f")
_NUMBERS = (
    *("prnu_fraction", "dsnu_fraction", "pixel_fpn_fraction", "line_fpn_fraction", "gain_fpn_fraction"),
    *("hot_fraction", "dead_fraction", "rts_fraction", "nonlinearity_fraction", "hot_e_per_s", "rts_e"),
    *("temperature_k", "dark_reference_k", "dark_doubling_k", "v_sat_v", "pedestal_v"),
)

#: One value for all sites, or an array (n_site,).
PerSite = float | NDArray[np.float64]


class Photosites(PackedRings, Neighbourhood, Protocol):
    """Outlines with a colour channel per site, as the sensor needs them; :class:`foveasim.Layout` is one."""

    @property
    def n_sites(self) -> int:
        """Number of sites."""

    @property
    def channel(self) -> Ints:
        """Index of each site's colour filter, (n_site,)."""

    @property
    def readout_line(self) -> Ints:
        """Line that each site is read through, (n_site,)."""

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Data per site by name; ``channel`` is among them where sites differ in colour."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """
    Photosites with their electronics.

    The order of effects: expected photons x quantum efficiency x filter x PRNU, + dark charge, charge diffusion, **one**
    Poisson draw, full well, + kTC noise, read noise and telegraph noise, volts (q/C) with gain FPN and non-linearity,
    + offset FPN of pixel and line, clip to 0 .. V_sat, converter with its non-linearities. The defaults are a perfect sensor:
    every photon an electron, no noise but the shot noise of light.

    Parameters
    ----------
    layout : Layout
        The photosites; their ``channel`` chooses the filter, and their ``readout_line`` the line of the converter.
    qe : float or curve, or one for each filter
        Quantum efficiency, electrons per photon: a number, or a function of the wavelength in nm, such as
        :class:`SiliconQE` or :class:`PolynomialCurve`.
    filters : None, "rgb", or FilterSet
        Colour filters; None for a sensor without, whatever the layout's channels, "rgb" for :func:`rgb_filters`.
    sensitivity : float or (n_site,)
        Share of the light that a site collects beside its quantum efficiency and filter, as of a smaller lens or opening.
    prnu_fraction : float
        Photo-response non-uniformity: standard deviation of the sites' response over its mean, a Gaussian distribution; at
        most 0.3.
    dark_e_per_s : float or (n_site,), e-/s
        Dark current at ``dark_reference_k``.
    temperature_k, dark_reference_k, dark_doubling_k : float, K
        Temperature of the sensor, the one that the dark current is of, and the rise that doubles it.
    dsnu_fraction : float
        Dark-signal non-uniformity: standard deviation of the sites' dark current over its mean, ``dark_e_per_s``, a log-normal
        distribution: no site is below 0, however wide it is.
    hot_fraction, hot_e_per_s : float
        Share of the sites that have this much more dark current (e-/s, at ``dark_reference_k``).
    dead_fraction : float
        Share of the sites that collect no light.
    crosstalk : Diffusion or KernelCrosstalk, optional
        Charge that goes to neighbours before it is collected.
    shot_noise : {"auto", "exact", "off"}
        See :func:`foveasim.sensor.draw_shot_noise`.
    gaussian_above_e : float, e-
        Expectation above which ``"auto"`` takes the Gaussian for the Poisson law.
    full_well_e : float or (n_site,), optional, e-
        Charge that a site can hold; None for no limit but V_sat.
    coupling : Coupling, optional
        Charge that is read at neighbours, after the draw.
    ktc_noise : bool
        Whether resetting leaves the noise ``sqrt(k T C)`` on the charge.
    cds : bool
        Correlated double sampling: the level after the reset is subtracted, which takes off kTC noise and the pixels' offset
        FPN. ``read_noise_e`` is what remains.
    read_noise_e : float or (n_site,), e-
        Standard deviation of the Gaussian noise of reading.
    rts_fraction, rts_e : float
        Random telegraph noise: share of the sites that are in either of two states, so many e- apart, by chance in each frame.
    capacitance_f : float or (n_site,), F
        Capacitance that the charge is read on: 1e-13 F in the paper's foveal run.
    gain_fpn_fraction : float
        Standard deviation of the sites' volts per charge over its mean, a Gaussian distribution; at most 0.3.
    nonlinearity_fraction : float
        Share of the voltage that the response lacks at V_sat, growing with the square of the voltage.
    pedestal_v : float, V
        Black level: added to every voltage, so that noise of dark frames is not cut off at code 0. Less than ``v_sat_v``.
    pixel_fpn_fraction, line_fpn_fraction : float
        Standard deviation of the offsets of pixels, and of readout lines, over V_sat (the paper: 0.02).
    v_sat_v : float, V
        Voltage that gives the highest code; nothing above it is seen.
    bits, companding, log_strength, companding_table, inl_dn, dnl_dn
        Of the converter: see :class:`foveasim.sensor.Converter`.
    device_seed : int
        Which of all devices of this kind it is: seed of everything that is fixed from its making on.

    Raises
    ------
    ParameterError
        When a value is out of range or implausible (:data:`foveasim.sensor.LIMITS`), or an array does not have one value a
        site.
    SimulationError
        When the layout's channels need more filters than there are, or lines are told apart that the layout has not.
    """

    layout: Photosites
    _: KW_ONLY
    qe: float | Curve | Sequence[float | Curve] = 1.0
    filters: FilterSet | Literal["rgb"] | None = None
    sensitivity: PerSite = 1.0
    prnu_fraction: float = 0.0
    dark_e_per_s: PerSite = 0.0
    temperature_k: float = 300.0
    dark_reference_k: float = 300.0
    dark_doubling_k: float = 8.0
    dsnu_fraction: float = 0.0
    hot_fraction: float = 0.0
    hot_e_per_s: float = 0.0
    dead_fraction: float = 0.0
    crosstalk: Diffusion | KernelCrosstalk | None = None
    shot_noise: ShotNoise = "auto"
    gaussian_above_e: float = 100.0
    full_well_e: PerSite | None = None
    coupling: Coupling | None = None
    ktc_noise: bool = False
    cds: bool = False
    read_noise_e: PerSite = 0.0
    rts_fraction: float = 0.0
    rts_e: float = 0.0
    capacitance_f: PerSite = 1e-13
    gain_fpn_fraction: float = 0.0
    nonlinearity_fraction: float = 0.0
    pedestal_v: float = 0.0
    pixel_fpn_fraction: float = 0.0
    line_fpn_fraction: float = 0.0
    v_sat_v: float = 3.0
    bits: int = 8
    companding: Companding = "linear"
    log_strength: float = 100.0
    companding_table: Sequence[float] | None = None
    inl_dn: Sequence[float] = ()
    dnl_dn: float = 0.0
    device_seed: int = 0

    def __post_init__(self) -> None:
        if not all(hasattr(self.layout, name) for name in ("n_sites", "channel", "columns")):
            raise ParameterError("layout", f"must be a Layout, got a {type(self.layout).__name__}")
        if isinstance(self.qe, list | tuple):
            object.__setattr__(self, "qe", tuple(self.qe))
        elif not callable(self.qe):
            object.__setattr__(self, "qe", check_number("qe", self.qe, at_least=0.0, at_most=1.0))
        is_rgb = isinstance(self.filters, str) and self.filters == "rgb"
        if self.filters is not None and not is_rgb and not isinstance(self.filters, FilterSet):
            raise ParameterError("filters", "must be None, 'rgb' or a FilterSet", self.filters)
        for name in _PER_SITE:
            value = getattr(self, name)
            if value is not None or name != "full_well_e":
                object.__setattr__(self, name, self._per_site(name, value))
        numbers: dict[str, float] = {
            **{name: check_plausible(name, getattr(self, name)) for name in _NUMBERS},
            "gaussian_above_e": check_number(
                "gaussian_above_e", self.gaussian_above_e, at_least=10.0, at_most=MOST_INVERTED_E
            ),
            "device_seed": check_count("device_seed", self.device_seed, at_least=0),
        }
        if numbers["pedestal_v"] >= numbers["v_sat_v"]:
            raise ParameterError(
                "pedestal_v",
                f"must be < v_sat_v = {numbers['v_sat_v']:g} V",
                numbers["pedestal_v"],
                "V",
                "a pedestal above the range gives every site the highest code",
            )
        for name, number in numbers.items():
            object.__setattr__(self, name, number)
        hottest_e_per_s = self.heat * float(np.max(self.dark_e_per_s, initial=0.0) + self.hot_e_per_s)
        if hottest_e_per_s > LIMITS["dark_e_per_s"].high:
            raise ParameterError(
                "dark_e_per_s",
                f"{LIMITS['dark_e_per_s'].rule} at temperature_k = {self.temperature_k:g} K",
                hottest_e_per_s,
                "e-/s",
                "check dark_reference_k and dark_doubling_k",
            )
        for name in ("ktc_noise", "cds"):
            if not isinstance(getattr(self, name), bool):
                raise ParameterError(name, "must be true or false", getattr(self, name))
        check_choice("shot_noise", self.shot_noise, ("auto", "exact", "off"))
        for name, kinds in (("crosstalk", (Diffusion, KernelCrosstalk)), ("coupling", (Coupling,))):
            part = getattr(self, name)
            if part is not None and not isinstance(part, kinds):
                raise ParameterError(name, f"must be a {' or a '.join(k.__name__ for k in kinds)}", part)
        _ = self._filters_and_qe
        for name in ("bits", "companding_table", "inl_dn"):
            object.__setattr__(self, name, getattr(self.converter, name))
        if (self.line_fpn_fraction or self.dnl_dn) and "readout_line" not in self.layout.columns:
            raise SimulationError(
                "lines of readout differ, but the layout does not say which site is on which; give it a column 'readout_line', "
                "for example with foveasim.layout.readout_by or nearest_bus"
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

    def _per_site(self, name: str, value: PerSite) -> PerSite:
        if np.ndim(value) == 0:
            return check_plausible(name, value)
        array = check_plausible_array(name, value, ndim=1)
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

    @cached_property
    def _filters_and_qe(self) -> FilterSet:
        try:
            return self._filter_set * self.qe
        except ParameterError as error:
            raise ParameterError("qe", error.told) from None

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

    def _transmission(self, wavelength_nm: Floats) -> Floats:
        """Filter times efficiency, (n_filter, n_wavelength); a function that fails is named by its parameter."""
        try:
            return self._filters_and_qe.transmission(wavelength_nm)
        except CurveError as error:
            name = "qe"
            try:
                self._filter_set.transmission(wavelength_nm)
            except CurveError:
                name = "filters"
            raise ParameterError(name, error.told) from error.__cause__

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
            When a quantum efficiency or a filter leaves 0 .. 1, or is not known at a wavelength; when a function given for one
            fails, or returns other than one number per wavelength: the message names it, and its error is the cause.
        """
        curves = self._transmission(wavelength_nm)
        if not (np.isfinite(curves).all() and curves.min() >= 0.0 and curves.max() <= 1.0):
            raise ParameterError("qe", "and the filters must give values from 0 to 1 at every wavelength", curves)
        return curves / photon_energy_j(wavelength_nm)

    # -- what differs from site to site ------------------------------------------------------------------------------

    @cached_property
    def converter(self) -> Converter:
        """The analogue-to-digital converter."""
        return Converter(
            bits=self.bits,
            companding=self.companding,
            log_strength=self.log_strength,
            companding_table=self.companding_table,
            inl_dn=self.inl_dn,
            dnl_dn=self.dnl_dn,
        )

    @cached_property
    def device(self) -> Device:
        """What is fixed from the device's making on."""
        return Device(self.device_seed, self.layout)

    @cached_property
    def response(self) -> Floats:
        """Relative response of every site to light, (n_site,) or (1,): sensitivity, PRNU and dead sites."""
        gain = np.atleast_1d(np.asarray(self.sensitivity, np.float64))
        if self.prnu_fraction:
            gain = gain * np.maximum(1.0 + self.prnu_fraction * self.device.normals("prnu"), 0.0)
        if self.dead_fraction:
            gain = np.where(self.device.uniforms("dead") < self.dead_fraction, 0.0, gain)
        return read_only(gain.copy())

    @cached_property
    def dark_rate_e_per_s(self) -> Floats:
        """Dark current of every site at the sensor's temperature, (n_site,) or (1,) e-/s: DSNU and hot sites."""
        rate = np.atleast_1d(np.asarray(self.dark_e_per_s, np.float64)).copy()
        if self.dsnu_fraction:
            rate = rate * self.device.log_normals("dsnu", self.dsnu_fraction)
        if self.hot_fraction:
            rate = rate + self.hot_e_per_s * (self.device.uniforms("hot") < self.hot_fraction)
        return read_only(rate * self.heat)

    @property
    def heat(self) -> float:
        """Dark current at the sensor's temperature over that at ``dark_reference_k``."""
        try:
            return float(2.0 ** ((self.temperature_k - self.dark_reference_k) / self.dark_doubling_k))
        except OverflowError:
            return float("inf")

    @cached_property
    def ktc_noise_e(self) -> Floats:
        """Standard deviation of the noise of resetting, ``sqrt(k T C) / q``, (n_site,) or (1,) e-; 0 where it is off."""
        if not self.ktc_noise or self.cds:
            return read_only(np.zeros(1))
        capacitance_f = np.atleast_1d(np.asarray(self.capacitance_f, np.float64))
        return read_only(np.sqrt(BOLTZMANN_J_PER_K * self.temperature_k * capacitance_f) / ELEMENTARY_CHARGE_C)

    @cached_property
    def rts_noise_e(self) -> Floats:
        """Standard deviation of every site's RTS noise, (n_site,) or (1,) e-: half the distance of its two states."""
        if not self.telegraph_sites.size:
            return read_only(np.zeros(1))
        noise_e = np.zeros(self.layout.n_sites)
        noise_e[self.telegraph_sites] = 0.5 * self.rts_e
        return read_only(noise_e)

    def readout_noise_e2(self, *, is_reset: bool = True, is_device_known: bool = True) -> Floats:
        """
        Variance of every site's charge by its readout: reset (kTC), read and RTS noise.

        Parameters
        ----------
        is_reset : bool
            Whether reset noise counts: it does not in differences of reads of one charge.
        is_device_known : bool
            Whether the device's RTS sites are known; otherwise every site has the mean RTS variance of all.

        Returns
        -------
        variance_e2 : (n_site,) or (1,) float64, e-²
            Before quantisation. RTS noise of two equally probable states ``rts_e`` apart has the variance ``rts_e² / 4``.
        """
        rts_e2 = np.square(self.rts_noise_e) if is_device_known else np.full(1, self.rts_fraction * self.rts_e**2 / 4.0)
        reset_e2 = np.square(self.ktc_noise_e) if is_reset else np.zeros(1)
        return np.asarray(np.atleast_1d(np.square(self.read_noise_e)) + reset_e2 + rts_e2)

    @cached_property
    def gain(self) -> Floats:
        """Relative volts per charge of every site, (n_site,) or (1,)."""
        if not self.gain_fpn_fraction:
            return read_only(np.ones(1))
        return read_only(np.maximum(1.0 + self.gain_fpn_fraction * self.device.normals("gain"), 0.0))

    @cached_property
    def pixel_offset_v(self) -> Floats:
        """Offset of every site, (n_site,) or (1,) V: the pedestal and, without double sampling, its own."""
        if not self.pixel_fpn_fraction or self.cds:
            return read_only(np.full(1, self.pedestal_v))
        return read_only(self.pedestal_v + self.v_sat_v * self.pixel_fpn_fraction * self.device.normals("pixel offset"))

    @cached_property
    def line_offset_v(self) -> Floats:
        """Offset of every readout line by its number, (n_line,) or (1,) V."""
        if not self.line_fpn_fraction:
            return read_only(np.zeros(1))
        lines = np.arange(int(self.layout.readout_line.max(initial=0)) + 1)
        offset_v = self.v_sat_v * self.line_fpn_fraction * self.device.line_normals("line offset", lines)
        return read_only(np.resize(offset_v, max(lines.size, 2)))

    @cached_property
    def telegraph_sites(self) -> Ints:
        """Sites with random telegraph noise."""
        return np.flatnonzero(self.device.uniforms("telegraph") < self.rts_fraction) if self.rts_fraction else NO_SITES

    @cached_property
    def _crosstalk(self) -> Mixing | None:
        return None if self.crosstalk is None else self.crosstalk.mixing(self.layout)

    @cached_property
    def _coupling(self) -> Mixing | None:
        if self.coupling is None:
            return None
        per_site = None if np.ndim(self.capacitance_f) == 0 else self.capacitance_f
        return self.coupling.mixing(self.layout, capacitance_f=per_site)

    # -- charge and code ------------------------------------------------------------------------------------------

    def expected_electrons(self, photo_e_per_s: Floats, exposure_s: float) -> Floats:
        """
        Expected charge of every site at the end of an exposure, (n_site,) e-: photoelectrons and dark charge, diffused.

        Raises
        ------
        ParameterError
            When the exposure is negative, or implausible.
        """
        exposure_s = check_plausible("exposure_s", exposure_s)
        photo_e_per_s = unmasked("photo_e_per_s", photo_e_per_s)
        expected_e = (photo_e_per_s * self.response + self.dark_rate_e_per_s) * exposure_s
        return expected_e if self._crosstalk is None else self._crosstalk.apply(expected_e)

    def collect(self, expected_e: Floats, *, streams: Streams, n_threads: int | None = None) -> Ints:
        """Charge that a draw gives, (n_site,) int64 e-: shot noise, then the full well."""
        expected_e = self._checked_charges("expected_e", expected_e)
        electrons = draw_shot_noise(expected_e, self.shot_noise, self.gaussian_above_e, streams, n_threads=n_threads)
        if self.full_well_e is not None:
            well_e = np.floor(np.minimum(self.full_well_e, LARGEST_CHARGE_E)).astype(np.int64)
            np.minimum(electrons, well_e, out=electrons)
        return electrons

    def read(self, electrons: Ints, *, streams: Streams, n_threads: int | None = None) -> NDArray[Any]:
        """
        Digital code of every charge, (n_site,) uint8 or uint16.

        Noise of resetting and reading, volts, offsets, the clip at V_sat and the converter: without companding and faults
        code ``k`` stands for the voltages from ``k * V_sat / 2**bits`` to the next.
        """
        from foveasim.sensor import _kernels

        electrons = self._checked_charges("electrons", electrons, at_least=-np.inf)
        code = np.empty(electrons.size, np.uint8 if self.bits <= 8 else np.uint16)
        noises_e = {"reset": self.ktc_noise_e, "read": np.atleast_1d(np.asarray(self.read_noise_e, np.float64))}
        noises_e = {effect: sigma_e for effect, sigma_e in noises_e.items() if sigma_e.any()}
        v_per_e = np.atleast_1d(electrons_to_volts(1.0, self.capacitance_f))
        line = np.ascontiguousarray(self.layout.readout_line)
        telegraph_e = self._telegraph_e(streams)
        read_out = _kernels.read_out
        conversion = self._conversion

        charges: NDArray[Any] = electrons if self._coupling is None else self._coupling.apply(electrons)

        def block(number: int, whole: slice) -> None:
            generators = {effect: streams.of(effect, number) for effect in noises_e}
            # Each block has one random stream per effect; pieces of a block fit the processor's cache.
            for sites in pieces(whole):
                charge_e = charges[sites].astype(np.float64)
                for effect, sigma_e in noises_e.items():
                    noise = generators[effect].standard_normal(charge_e.size)
                    noise *= _part(sigma_e, sites)
                    charge_e += noise
                if telegraph_e is not None:
                    charge_e += telegraph_e[sites]
                read_out(
                    charge_e,
                    _part(v_per_e, sites),
                    _part(self.pixel_offset_v, sites),
                    self.line_offset_v,
                    _part(self.gain, sites),
                    line[sites],
                    *conversion,
                    code[sites],
                )

        in_blocks(electrons.size, block, n_threads)
        return code

    @property
    def _conversion(self) -> tuple[Any, ...]:
        """Arguments of the kernels from volts to codes: range, nonlinearity and ADC."""
        adc = self.converter
        return (
            self.v_sat_v,
            self.nonlinearity_fraction,
            adc.way,
            adc.log_strength,
            adc.curve,
            adc.n_codes,
            adc.inl,
            adc.dnl_dn,
            self.device.key("dnl")[0] & np.uint64(0xFFFFFFFF),
            adc.quantiles,
        )

    def _checked_charges(self, name: str, charge_e: ArrayLike, at_least: float = 0.0) -> NDArray[Any]:
        charges = np.asarray(unmasked(name, charge_e))
        if charges.shape != (self.layout.n_sites,):
            raise ParameterError(
                name, f"must be one number for each of the {self.layout.n_sites} sites, got {charges.shape}"
            )
        if charges.size and not np.min(charges) >= at_least:
            raise ParameterError(name, f"must be >= {at_least:g} everywhere", float(np.min(charges)), "e-")
        return charges

    def checked_charges(self, name: str, charge_e: ArrayLike) -> Floats:
        """
        Charges of all sites as an array, (n_site,) float64 e-.

        Raises
        ------
        ParameterError
            When there is not one charge of at least 0 for each site.
        """
        return np.ascontiguousarray(self._checked_charges(name, charge_e), np.float64)

    def coupled(self, mean_e: Floats, variance_e2: Floats) -> tuple[Floats, Floats]:
        """Mean and variance of independent charges after inter-pixel coupling, (n_site,) e- and e-² each."""
        if self._coupling is None:
            return mean_e, variance_e2
        return self._coupling.apply(mean_e), self._coupling.variance(variance_e2)

    def _telegraph_e(self, streams: Streams) -> Floats | None:
        sites = self.telegraph_sites
        if sites.size == 0 or not self.rts_e:
            return None
        charge_e = np.zeros(self.layout.n_sites)
        charge_e[sites] = self.rts_e * (streams.of("telegraph").random(sites.size) - 0.5 > 0.0) - 0.5 * self.rts_e
        return charge_e

    def calibrate(
        self, *, exposure_s: float, flat_e: ArrayLike, n_frames: int, seed: int, **options: Any
    ) -> Calibration:
        """Take dark and flat frames, and calibrate: :func:`foveasim.sensor.calibrate`, whose parameters these are."""
        from foveasim.sensor.calibration import calibrate

        return calibrate(self, exposure_s=exposure_s, flat_e=flat_e, n_frames=n_frames, seed=seed, **options)

    def predict(self, expected_e: Floats, *, n_threads: int | None = None) -> tuple[Floats, Floats]:
        """
        Mean and variance of every site's code over all draws, for this device, without a draw.

        Parameters
        ----------
        expected_e : (n_site,) float64, e-
            As :meth:`expected_electrons` gives it.
        n_threads : int, optional

        Returns
        -------
        mean_dn, variance_dn2 : (n_site,) float64, DN and DN²
            Of the codes: quantisation, clips and the converter's faults included.

        Raises
        ------
        ParameterError
            When there is not one charge of at least 0 for each site.

        Notes
        -----
        The code is even between borders of the charge, and weighs what the charge's distribution has between: Poisson's law up
        to ``gaussian_above_e`` (for ``"exact"`` too: above it a Gaussian), cut off by the full well, with the Gaussian noise
        of resetting and reading and the telegraph's two states. Coupled charges are taken as Gaussian of the coupled variance.
        """
        from foveasim.sensor import _kernels

        expected_e = self.checked_charges("expected_e", expected_e)
        mean_dn, variance_dn2 = np.empty(expected_e.size), np.empty(expected_e.size)
        well_e = np.array([np.inf]) if self.full_well_e is None else np.floor(np.atleast_1d(self.full_well_e))
        sigma_e = np.sqrt(self.ktc_noise_e**2 + np.atleast_1d(self.read_noise_e) ** 2)
        is_drawn = self.shot_noise != "off"
        drawn_e, drawn_e2 = expected_e, np.zeros(1)
        if not is_drawn:
            drawn_e = np.minimum(np.rint(expected_e), well_e)
        if self._coupling is not None:
            # What the well leaves of a draw is mixed, and taken as a Gaussian.
            mean_e, variance_e2 = _cut_off(drawn_e, drawn_e if is_drawn else np.zeros(1), well_e)
            drawn_e, drawn_e2 = self.coupled(mean_e, variance_e2)
            is_drawn, well_e = False, np.array([np.inf])
        points, shares = _quadrature()
        line = np.ascontiguousarray(self.layout.readout_line)
        v_per_e = np.atleast_1d(electrons_to_volts(1.0, self.capacitance_f))
        conversion = self._conversion
        predict_codes = _kernels.predict_codes

        def block(_: int, sites: slice) -> None:
            predict_codes(
                drawn_e[sites],
                _part(drawn_e2, sites),
                self.gaussian_above_e,
                is_drawn,
                _part(well_e, sites),
                _part(sigma_e, sites),
                _part(self.rts_noise_e, sites),
                _part(v_per_e, sites),
                _part(self.gain, sites),
                _part(self.pixel_offset_v, sites),
                self.line_offset_v,
                line[sites],
                *conversion,
                points,
                shares,
                mean_dn[sites],
                variance_dn2[sites],
            )

        in_blocks(expected_e.size, block, n_threads)
        return mean_dn, variance_dn2


def _part(values: Floats, sites: slice) -> Floats:
    """Values of some sites, or the one of all."""
    return values[sites] if values.size > 1 else values


@cache
def _quadrature() -> tuple[Floats, Floats]:
    """Gauss's points and weights from -1 to 1: an eigenvalue problem, which takes longer than the codes of a small sensor."""
    points, shares = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    return read_only(points), read_only(shares)


def _cut_off(mean_e: Floats, variance_e2: Floats, end_e: Floats) -> tuple[Floats, Floats]:
    """Mean and variance of a Gaussian whose values beyond an end are put to it."""
    from scipy.special import ndtr

    deviation = np.sqrt(np.maximum(variance_e2, 1e-12))
    z = np.clip((end_e - mean_e) / deviation, -40.0, 40.0)
    below, at = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    # How far below the end, and its square; where all lies far below, the Gaussian itself.
    short = deviation * (z * below + at)
    short2 = deviation**2 * ((1.0 + z * z) * below + z * at)
    is_free = z >= 40.0
    cut = np.where(is_free, mean_e, np.where(is_free, 0.0, end_e) - short)
    return cut, np.where(is_free, variance_e2, np.maximum(short2 - short**2, 0.0))
