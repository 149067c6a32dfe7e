"""Sensor: conversion of optical power at the photosites to digital codes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, Limits, OwnCheck, Usual, check_declared
from foveasim._core.names import CHANNEL_LETTERS, find_wrong_letter, possible_names
from foveasim._core.provenance import copy_plain_data, large_arrays
from foveasim._core.random_streams import Streams
from foveasim._core.show import view_method
from foveasim._core.threads import cached_property
from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_broadcast,
    as_numbers,
    check_broadcast,
    check_per_site,
    finite_array,
    read_only,
    unmasked,
    wavelengths_nm,
)
from foveasim.errors import ParameterError, SimulationError, format_value, type_name
from foveasim.sensor.adc import ADC, BITS, DNL, INL, LOG_STRENGTH, Companding, ConversionTables
from foveasim.sensor.chain import (
    ChargeCheck,
    Conversion,
    Factor,
    FullWell,
    Nonlinearity,
    Offset,
    Save,
    Step,
    check_effects,
    check_names,
    merge_steps,
    run_steps,
    sort_by_stage,
)
from foveasim.sensor.device import Device
from foveasim.sensor.effects import Collection, Effect, Photosites, Sites, Stage
from foveasim.sensor.effects.contract import FixedFactor, FixedOffset
from foveasim.sensor.effects.crosstalk import Diffusion, InterPixelCapacitance, KernelCrosstalk
from foveasim.sensor.effects.dark import ACTIVATION, DOUBLING, DarkLaw, DarkSignal, HotSites, dark_current_factor
from foveasim.sensor.effects.fixed_pattern import (
    ColumnOffset,
    DarkOffset,
    DeadSites,
    PhotoResponse,
    PixelGain,
    PixelOffset,
)
from foveasim.sensor.effects.readout import ReadNoise, ResetNoise, TelegraphNoise
from foveasim.sensor.effects.shot import GAUSSIAN_ABOVE, ShotChoice, ShotNoise
from foveasim.sensor.limits import (
    ALTERNATIVES,
    CHARGE,
    EXPOSURE,
    GAIN,
    NOISE,
    OFFSET,
    RATE,
    SHARE,
    SPREAD,
    TEMPERATURE,
    VOLTS,
    WIDE_SPREAD,
)
from foveasim.sensor.model.auto_exposure import AUTO_PERCENTILE, AUTO_TARGET, PERCENTILE, TARGET, exposure_for
from foveasim.sensor.model.codes import predict, predict_covariance
from foveasim.sensor.model.inversion import Inverse, invert, invert_collection
from foveasim.sensor.model.linearisation import Linearisation, linearise
from foveasim.sensor.model.prediction import (
    ReadoutModel,
)
from foveasim.sensor.model.records import Record, light_records, map_light, readout_model
from foveasim.sensor.pixel_optics import PixelOptics
from foveasim.sensor.published.datasheet import DataSheet, read_datasheet
from foveasim.sensor.published.presets import find_preset, with_changes
from foveasim.sensor.spectral.curves import ConstantCurve, Curve, CurveError
from foveasim.sensor.spectral.response import FilterSet, rgb_filters
from foveasim.units import ELEMENTARY_CHARGE_C, electrons_to_volts, photon_energy_j

if TYPE_CHECKING:
    from foveasim.sensor.calibration import Calibration

__all__ = ["PerSite", "Photosites", "Sensor"]

#: Parameters that depend on the wavelength, which the settings of captures do not restore.
SPECTRAL = ("qe", "filters")
#: One value for all sites, or an array (n_site,).
PerSite = float | NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """
    Image sensor: photosites with their electronics.

    Order of effects: expected photons x quantum efficiency x filter x PRNU, + dark signal, charge diffusion, **one** Poisson
    draw, full well, inter-pixel capacitance, + reset (kTC), read and RTS noise, conversion to volts (q/C) with gain FPN and
    nonlinearity, + pixel and column FPN, clipping to 0 .. V_sat, ADC with its nonlinearities. The defaults describe an ideal
    sensor: one electron per photon, and no noise except photon shot noise.

    Parameters
    ----------
    layout : Layout
        Photosites; the column ``channel`` selects the filter, and ``readout_line`` the readout line (ADC).
    qe : float or curve, or one for each filter
        Quantum efficiency, electrons per photon: a number, or a function of the wavelength in nm, such as
        :class:`SiliconQE` or :class:`PolynomialCurve`.
    filters : None, "rgb", or FilterSet
        Colour filters; "rgb" for :func:`rgb_filters`, None for a sensor without filters, for any channels of the layout.
    sensitivity : float or (n_site,)
        Fraction of the incident power that a site collects, in addition to quantum efficiency and filter, as for a smaller
        microlens or opening.
    prnu_fraction : float
        Photo-response non-uniformity (PRNU): standard deviation over mean of a Gaussian distribution.
    dark_e_per_s : float or (n_site,), e-/s
        Dark current at ``dark_reference_k``.
    temperature_k, dark_reference_k : float, K
        Temperature of the sensor, and reference temperature of the dark current.
    dark_law : {"doubling", "arrhenius", "diffusion_generation"}
        Temperature dependence of the dark current: see :func:`foveasim.sensor.effects.dark_current_factor`. The default is
        the rule of EMVA 1288; far below the reference temperature it is too bright.
    dark_doubling_k, dark_activation_ev, dark_diffusion_fraction : float
        Parameters of the three laws: temperature rise that doubles the dark current, K; activation energy, eV; fraction of the
        diffusion current at ``dark_reference_k``.
    dsnu_fraction : float
        Non-uniformity of the dark current: its standard deviation over its mean. The distribution is log-normal with mean
        ``dark_e_per_s``, so that values are never negative. It is not the DSNU of data sheets, which is ``dsnu_e``: with a
        dark current of 1 e-/s and 0.01 s, dark frames differ by 0.001 e- for 0.1.
    hot_fraction, hot_e_per_s : float
        Fraction of hot sites, and their additional dark current (e-/s, at ``dark_reference_k``).
    dead_fraction : float
        Fraction of dead sites, which have no photo response.
    pixel_optics : PixelOptics, optional
        Openings, layers and microlenses above the photodiodes: :class:`ApertureStack`, :class:`Microlens`. A camera computes
        the light that each site collects from the cone of its optics, at the site's position in the image.
    crosstalk : Diffusion or KernelCrosstalk, optional
        Charge exchange between neighbours before collection.
    shot_noise : {"auto", "exact", "off"}
        See :class:`foveasim.sensor.effects.ShotNoise`.
    gaussian_above_e : float, e-
        Expectation above which ``"auto"`` approximates the Poisson distribution by its first three moments.
    full_well_e : float or (n_site,), optional, e-
        Full well capacity, in whole electrons: fractions have no effect. None for no limit except V_sat.
    coupling : InterPixelCapacitance, optional
        Inter-pixel capacitance, which acts after the draw.
    ktc_noise : bool
        Whether reset adds kTC noise, ``sqrt(k T C)`` in charge.
    cds : bool
        Correlated double sampling: subtracts the reset level, which removes kTC noise and pixel FPN. ``read_noise_e`` is then
        the remaining noise.
    read_noise_e : float or (n_site,), e-
        Standard deviation of the Gaussian read noise.
    rts_fraction, rts_e : float
        Random telegraph (RTS) noise: fraction of affected sites, and difference between their two states, e-.
    dsnu_e : float, e-
        Dark-signal non-uniformity (DSNU) of EMVA 1288: standard deviation over the sites of dark frames, for any exposure time.
        A fixed Gaussian offset, which correlated double sampling does not remove; instead of ``pixel_fpn_fraction``.
    capacitance_f : float or (n_site,), F, optional
        Capacitance of the sense node; by default 1.5e-16 F per µm² of the area of a site, so that all sites saturate at equal
        irradiances: at 2,809 e-/µm² for 3 V. The paper's foveal run has 1e-13 F for all sites.
    gain_dn_per_e : float or (n_site,), DN/e-, optional
        System gain K of EMVA 1288, instead of ``capacitance_f``: the capacitance is ``2**bits q / (K v_sat_v)``. With
        companding, K is the mean from 0 to V_sat.
    gain_fpn_fraction : float
        Gain FPN: standard deviation over mean of the conversion gain, a Gaussian distribution.
    nonlinearity_fraction : float
        Response nonlinearity: relative voltage loss at V_sat; the loss grows with the square of the voltage. Negative for
        a response that rises above the straight line.
    pedestal_v : float, V
        Black level added to all voltages, so that noise of dark frames is not clipped at code 0. Less than ``v_sat_v``.
    pixel_fpn_fraction, line_fpn_fraction : float
        Standard deviation of pixel FPN and of column FPN over V_sat (the paper: 0.02).
    v_sat_v : float, V
        Saturation voltage, at the end of the ADC range; higher voltages are clipped.
    bits, companding, log_strength, companding_table, inl_dn, dnl_dn
        ADC parameters: see :class:`foveasim.sensor.adc.ADC`.
    device_seed : int
        Seed of the fixed patterns, which identifies one device among all devices of this kind.
    effects : sequence of Effect
        Additional noise sources and fixed patterns: :mod:`foveasim.sensor.effects`. They are included in captures, predictions,
        the noise budget and all weights that depend on noise. A collection replaces the shot noise.
    disabled : sequence of str
        Names of effects to switch off, including those of keywords. Draws of the other effects do not change.
    provenance : mapping, optional
        Where the values come from, as plain data; empty by default. Of data sheets and presets: title, source, printed and
        derived quantities, assumptions, and the names of replaced parameters. It has no effect on results.

    Raises
    ------
    ParameterError
        If a value is out of range or implausible (:data:`foveasim.sensor.LIMITS`), or the length of an array is not the number
        of sites.
    SimulationError
        If the layout has channels without a filter, or lacks the column ``channel`` or ``readout_line`` where it is required.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.mosaic(fs.layout.grid(n_x=64, n_y=64, pitch_um=3.0), "RGGB")
    >>> sensor = fs.Sensor(
    ...     layout, filters="rgb", qe=0.6, read_noise_e=2.0, full_well_e=1e4, bits=12
    ... )
    >>> [effect.name for effect in sensor.chain]
    ['shot', 'read']
    """

    layout: OwnCheck[Photosites]
    _: KW_ONLY
    qe: Annotated[float | Curve | Sequence[float | Curve], FRACTION] = 1.0
    filters: FilterSet | Literal["rgb"] | None = None
    sensitivity: Annotated[PerSite, SHARE] = 1.0
    prnu_fraction: Annotated[float, SPREAD] = 0.0
    dark_e_per_s: Annotated[PerSite, RATE] = 0.0
    temperature_k: Annotated[float, TEMPERATURE, Usual(230.0, 350.0)] = 300.0
    dark_reference_k: Annotated[float, TEMPERATURE, Usual(230.0, 350.0)] = 300.0
    dark_law: DarkLaw = "doubling"
    dark_doubling_k: Annotated[float, DOUBLING, Usual(4.0, 12.0)] = 8.0
    dark_activation_ev: Annotated[float, ACTIVATION, Usual(0.4, 1.3)] = 0.67
    dark_diffusion_fraction: Annotated[float, SHARE] = 0.5
    dsnu_fraction: Annotated[float, WIDE_SPREAD, Usual(0.0, 2.0)] = 0.0
    hot_fraction: Annotated[float, SHARE, Usual(0.0, 0.1)] = 0.0
    hot_e_per_s: Annotated[float, RATE] = 0.0
    dead_fraction: Annotated[float, SHARE, Usual(0.0, 0.1)] = 0.0
    pixel_optics: PixelOptics | None = None
    crosstalk: Diffusion | KernelCrosstalk | None = None
    shot_noise: ShotChoice = "auto"
    gaussian_above_e: Annotated[float, GAUSSIAN_ABOVE] = 100.0
    full_well_e: Annotated[PerSite | None, CHARGE] = None
    coupling: InterPixelCapacitance | None = None
    ktc_noise: bool = False
    cds: bool = False
    read_noise_e: Annotated[PerSite, NOISE, Usual(0.0, 50.0)] = 0.0
    rts_fraction: Annotated[float, SHARE, Usual(0.0, 0.1)] = 0.0
    rts_e: Annotated[float, NOISE] = 0.0
    dsnu_e: Annotated[float, NOISE, Usual(0.0, 50.0)] = 0.0
    capacitance_f: Annotated[
        PerSite | None, Limits(above=0.0, low=1e-18, at_most=1e-6, hint="capacitances are in farad: 1 fF is 1e-15")
    ] = None
    gain_dn_per_e: Annotated[PerSite | None, GAIN] = None
    gain_fpn_fraction: Annotated[float, SPREAD] = 0.0
    nonlinearity_fraction: Annotated[
        float, Limits(low=-0.5, at_most=0.5, hint="above 0.5 the voltage would decrease with charge"), Usual(0.0, 0.1)
    ] = 0.0
    pedestal_v: Annotated[float, VOLTS] = 0.0
    pixel_fpn_fraction: Annotated[float, OFFSET, Usual(0.0, 0.1)] = 0.0
    line_fpn_fraction: Annotated[float, OFFSET, Usual(0.0, 0.1)] = 0.0
    v_sat_v: Annotated[float, replace(VOLTS, above=0.0, low=1e-6), Usual(0.1, 5.0)] = 3.0
    bits: Annotated[int, BITS] = 8
    companding: Companding = "linear"
    log_strength: Annotated[float, LOG_STRENGTH] = 100.0
    companding_table: Sequence[float] | None = None
    inl_dn: Annotated[Sequence[float], INL] = ()
    dnl_dn: Annotated[float, DNL] = 0.0
    device_seed: Annotated[int, NOT_NEGATIVE] = 0
    effects: Sequence[Effect] = ()
    disabled: Iterable[str] = ()
    provenance: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if not all(hasattr(self.layout, name) for name in ("n_sites", "channel", "columns")):
            raise ParameterError("layout", f"must be a Layout, got {type_name(self.layout)}")
        check_declared(self, n_sites=self.layout.n_sites)
        if isinstance(self.qe, list | tuple):
            object.__setattr__(self, "qe", tuple(self.qe))
        elif not callable(self.qe):
            object.__setattr__(self, "qe", FRACTION.check("qe", self.qe))
        for first, second in ALTERNATIVES:
            if np.any(getattr(self, first)) and np.any(getattr(self, second)):
                raise ParameterError(second, f"must not be given together with '{first}': they specify one quantity")
        if self.pedestal_v >= self.v_sat_v:
            raise ParameterError(
                "pedestal_v",
                f"must be < v_sat_v = {self.v_sat_v:g} V",
                self.pedestal_v,
                "V",
                "with a pedestal above the range all sites have the highest code",
            )
        hottest_e_per_s = self.dark_current_ratio * float(np.max(self.dark_e_per_s, initial=0.0) + self.hot_e_per_s)
        if hottest_e_per_s > RATE.high:
            raise ParameterError(
                "dark_e_per_s",
                f"must be <= {RATE.high:g} at temperature_k = {self.temperature_k:g} K",
                hottest_e_per_s,
                "e-/s",
                "check dark_reference_k and the parameters of dark_law",
            )
        object.__setattr__(self, "provenance", MappingProxyType(copy_plain_data(dict(self.provenance or {}))))
        object.__setattr__(self, "effects", check_effects(self.effects))
        if self._own_collection is not None and (self.shot_noise, self.gaussian_above_e) != ("auto", 100.0):
            raise ParameterError(
                "shot_noise",
                f"and 'gaussian_above_e' must be the defaults with the collection '{self._own_collection.name}' in 'effects'",
            )
        object.__setattr__(self, "disabled", check_names(self.disabled, self.effects))
        _ = self._filters_and_qe
        for name in ("companding_table", "inl_dn"):
            object.__setattr__(self, name, getattr(self.adc, name))
        if (self.line_fpn_fraction or self.dnl_dn) and "readout_line" not in self.layout.columns:
            raise SimulationError(
                "column FPN and DNL require a readout line for each site, but the layout has no column 'readout_line'; add it, "
                "for example with foveasim.layout.readout_by or nearest_bus"
            )
        if self.filters is None:
            return
        if self.n_filters > 1 and "channel" not in self.layout.columns:
            raise SimulationError(
                f"the sensor has {self.n_filters} filters, but the layout has no column 'channel'; add it, for example with "
                "foveasim.layout.mosaic(layout, ('RG', 'GB')), or read it from the filter layers of a GDSII or OASIS file with "
                "channels={'10/0': 'R', ...}"
            )
        highest = int(self.layout.channel.max(initial=0))
        if highest >= self.n_filters:
            raise SimulationError(
                f"the layout has sites of channel {highest}, but the sensor has only filters 0 to {self.n_filters - 1} "
                f"({', '.join(self.filter_names)})"
            )
        letters = str(getattr(self.layout, "provenance", {}).get(CHANNEL_LETTERS, ""))
        wrong = (
            find_wrong_letter(letters, np.unique(self.filter_of_site).tolist(), self.filter_names) if letters else None
        )
        if wrong is not None:
            raise SimulationError(
                f"the layout has a mosaic of the letters {letters}, but filter {wrong} of the sensor is "
                f"{format_value(self.filter_names[wrong])}, not of the colour {letters[wrong]!r}; order the filters "
                f"({', '.join(self.filter_names)}) as the letters, or pass names= to foveasim.layout.mosaic"
            )

    @classmethod
    def from_preset(cls, layout: OwnCheck[Photosites], preset: str, **parameters: Any) -> Sensor:
        """
        Create a sensor with the electronics of a published one.

        Parameters
        ----------
        layout : Layout
        preset : {"mobile", "machine_vision", "scientific", "paper_foveal", ...}
            Name in :data:`foveasim.sensor.PRESETS`, which contains the sources. Full wells of measured pixels are proportional
            to the area of a site.
        **parameters
            Other parameters of the class, such as ``filters``, or values instead of those of the preset.

        Raises
        ------
        ParameterError
            If there is no such preset, or a parameter is invalid.

        Examples
        --------
        >>> import foveasim as fs
        >>> sensor = fs.Sensor.from_preset(
        ...     fs.layout.grid(n_x=4, n_y=3, pitch_um=3.45), "machine_vision"
        ... )
        >>> sensor.bits, sensor.provenance["printed"]["full_well_e"]
        (12, '10700')
        """
        ideal = cls(layout)  # checks the layout
        has_lines = "readout_line" in ideal.layout.columns
        values = find_preset(preset).values(ideal.layout.area_um2, has_lines=has_lines)
        return cls(layout, **with_changes(values, parameters))

    @classmethod
    def from_datasheet(
        cls, layout: OwnCheck[Photosites], sheet: OwnCheck[DataSheet | str | Path], **parameters: Any
    ) -> Sensor:
        """
        Create a sensor from the values of a data sheet in the terms of EMVA 1288.

        Parameters
        ----------
        layout : Layout
        sheet : DataSheet or path
            Values of the sheet, or its YAML file (:func:`foveasim.sensor.read_datasheet`). Sites of other areas than the pixel
            have full wells, dark currents and steps of the ADC in proportion to their area.
        **parameters
            Other parameters of the class, such as ``filters``, or values instead of those of the sheet, such as a curve of the
            quantum efficiency.

        Raises
        ------
        ParameterError
            If the sheet or a parameter is invalid.

        Examples
        --------
        >>> import foveasim as fs
        >>> sheet = fs.sensor.DataSheet(
        ...     pixel_um=2.25,
        ...     bits=12,
        ...     qe_percent=91.25,
        ...     gain_dn_per_e=0.399,
        ...     dark_noise_e=5.56,
        ...     saturation_e=9458,
        ...     black_level_dn=240,
        ... )
        >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.25)
        >>> sensor = fs.Sensor.from_datasheet(layout, sheet)
        >>> sensor.bits, sensor.read_noise_e, sensor.provenance["derived"]["threshold_e"]
        (12, 5.56, 'dark_noise_e, quantisation and 1/2')
        """
        if not isinstance(sheet, DataSheet | str | Path):
            raise ParameterError("sheet", f"must be a DataSheet, or the path of one, got {type_name(sheet)}")
        found = sheet if isinstance(sheet, DataSheet) else read_datasheet(sheet)
        ideal = cls(layout)  # checks the layout
        has_lines = "readout_line" in ideal.layout.columns
        return cls(layout, **with_changes(found.parameters(ideal.layout.area_um2, has_lines=has_lines), parameters))

    @classmethod
    def from_settings(
        cls, layout: Photosites, settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
    ) -> Sensor:
        """
        Create a sensor from the settings of a capture, without filters and quantum efficiency.

        Parameters
        ----------
        layout : Layout
            Layout of the capture.
        settings : mapping
            ``capture.settings["sensor"]``. Effects and pixel optics are identified by class among those of the package,
            :data:`foveasim.sensor.effects.EFFECTS` and :data:`foveasim.sensor.PIXEL_OPTICS`.
        arrays : mapping, optional
            ``capture.sensor_arrays``: arrays with more than 64 values, by their SHA-256 in the settings.

        Raises
        ------
        ParameterError
            If a parameter whose default is not 0 or None is missing, an array is missing in ``arrays``, or an effect is not
            registered.
        """
        from foveasim.sensor.restored import values_of

        return cls(layout, **values_of(cls, settings, arrays or {}))

    @cached_property
    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Arrays that settings store only as a checksum, by SHA-256."""
        parts = [getattr(self, each.name) for each in fields(Sensor) if each.name not in (*SPECTRAL, "layout")]
        return MappingProxyType(large_arrays(parts))

    def __repr__(self) -> str:
        return f"Sensor({self.layout!r}, filters {', '.join(self.filter_names)}, {self.bits} bits)"

    _repr_html_ = view_method("to_html")

    # -- filters and quantum efficiency -------------------------------------------------------------------------

    @cached_property
    def _filter_set(self) -> FilterSet:
        if self.filters is None:
            return FilterSet((ConstantCurve(1.0),), ("all",))
        return rgb_filters() if isinstance(self.filters, str) else self.filters

    @cached_property
    def _filters_and_qe(self) -> FilterSet:
        try:
            return self._filter_set * self.qe
        except ParameterError as error:
            raise ParameterError("qe", error.detail) from None

    @property
    def n_filters(self) -> int:
        """Number of colour filters; 1 for a sensor without filters."""
        return len(self._filter_set)

    @property
    def filter_names(self) -> tuple[str, ...]:
        """Names of the filters."""
        return tuple(self._filter_set.names or ())

    @cached_property
    def filter_of_site(self) -> Ints:
        """Index of each site's filter, (n_site,), of the smallest signed integer type."""
        if self.filters is None:
            return read_only(np.zeros(self.layout.n_sites, np.int8))
        return read_only(self.layout.channel.astype(np.min_scalar_type(-self.n_filters)))

    @cached_property
    def filters_used(self) -> Ints:
        """Indices of the filters of the layout's sites, in ascending order."""
        return read_only(np.flatnonzero(np.bincount(self.filter_of_site)))

    @cached_property
    def sites_of_filter(self) -> dict[int, Bools | None]:
        """Sites of each filter in :attr:`filters_used`, (n_site,) bool; None for all sites."""
        used = self.filters_used.tolist()
        return dict.fromkeys(used) if len(used) == 1 else {c: read_only(self.filter_of_site == c) for c in used}

    def _transmission(self, wavelength_nm: Floats) -> Floats:
        """Compute filter times quantum efficiency, (n_filter, n_wavelength)."""
        try:
            return self._filters_and_qe.transmission(wavelength_nm)
        except CurveError as error:
            name = "qe"
            try:
                self._filter_set.transmission(wavelength_nm)
            except CurveError:
                name = "filters"
            raise ParameterError(name, error.detail) from error.__cause__

    def filter_transmission(self, wavelength_nm: Floats) -> Floats:
        """Compute filter transmissions without quantum efficiency, (n_filter, n_wavelength)."""
        return self._filter_set.transmission(wavelengths_nm("wavelength_nm", wavelength_nm))

    def responsivity_e_per_j(self, wavelength_nm: Floats) -> Floats:
        """
        Compute the responsivity: electrons per joule incident on a site.

        Parameters
        ----------
        wavelength_nm : (n_wavelength,) float64, nm

        Returns
        -------
        responsivity : (n_filter, n_wavelength) float64, e-/J
            ``qe * filter * wavelength / (h c)``, read-only.

        Raises
        ------
        ParameterError
            If a quantum efficiency or a filter is outside 0 to 1, or undefined at a wavelength; if a user-defined curve fails,
            or does not return one number per wavelength (the message names the curve, its exception is the cause).
        """
        # Captures of the same scene compute it several times each.
        known: tuple[Floats, Floats] | None = self.__dict__.get("_responsivity")
        if known is not None and np.array_equal(known[0], wavelength_nm):
            return known[1]
        wavelength_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
        curves = self._transmission(wavelength_nm)
        if not (np.isfinite(curves).all() and curves.min() >= 0.0 and curves.max() <= 1.0):
            raise ParameterError("qe", "and 'filters' must have values from 0 to 1 at every wavelength", curves)
        found = read_only(curves / photon_energy_j(wavelength_nm))
        self.__dict__["_responsivity"] = np.array(wavelength_nm), found
        return found

    # -- ADC and device ------------------------------------------------------------------------------------------------

    @cached_property
    def adc(self) -> ADC:
        """Analogue-to-digital converter (ADC)."""
        return ADC(**{each.name: getattr(self, each.name) for each in fields(ADC)})

    @cached_property
    def device(self) -> Device:
        """Source of the fixed patterns."""
        return Device(self.device_seed, self.layout)

    # -- effects ------------------------------------------------------------------------------------------------

    @cached_property
    def chain(self) -> tuple[Effect, ...]:
        """All enabled effects of the sensor, in the order in which they act."""
        standard = [
            *self._keyword_effects(),
            *(effect for effect in (self.crosstalk, self.coupling) if effect is not None),
            self.collection,
        ]
        # Inter-pixel capacitance precedes the readout noise.
        standard.sort(key=lambda effect: effect.reach != "all")
        chain = sort_by_stage((*standard, *(effect for effect in self.effects if not isinstance(effect, Collection))))
        return tuple(effect for effect in chain if effect.name not in self.disabled or effect.stage == "collection")

    def _keyword_effects(self) -> Iterator[Effect]:
        """Yield the effects that numbers and switches specify, in the order of the chain."""
        if self.prnu_fraction:
            yield PhotoResponse(self.prnu_fraction)
        if self.dead_fraction:
            yield DeadSites(self.dead_fraction)
        if self.dsnu_fraction:
            yield DarkSignal(self.dsnu_fraction)
        if self.hot_fraction and self.hot_e_per_s:
            yield HotSites(self.hot_fraction, self.hot_e_per_s * self.dark_current_ratio)
        if self.ktc_noise and not self.cds:
            yield ResetNoise(self.temperature_k)
        if np.any(self.read_noise_e):
            yield ReadNoise(self.read_noise_e)
        if self.rts_fraction and self.rts_e:
            yield TelegraphNoise(self.rts_fraction, self.rts_e)
        if self.dsnu_e:
            yield DarkOffset(self.dsnu_e)
        if self.gain_fpn_fraction:
            yield PixelGain(self.gain_fpn_fraction)
        if self.pixel_fpn_fraction and not self.cds:
            yield PixelOffset(self.v_sat_v * self.pixel_fpn_fraction)
        if self.line_fpn_fraction:
            yield ColumnOffset(self.v_sat_v * self.line_fpn_fraction)

    def without(self, *names: str) -> Sensor:
        """
        Return the sensor with some effects switched off; other draws do not change.

        Parameters
        ----------
        *names : str
            Names of effects, as in :attr:`chain`: ``sensor.without("read", "prnu")``.
        """
        return replace(self, disabled=tuple(dict.fromkeys((*self.disabled, *names))))

    def with_angular_response(self, response: ArrayLike) -> Sensor:
        """
        Return the sensor with a known angular response as sensitivity, instead of pixel optics.

        Estimates of the light with it are corrected for the angular response: ``capture.picture(of="light_e", per="um2",
        sensor=camera.sensor.with_angular_response(camera.angular_response(scene)))``.

        Parameters
        ----------
        response : (n_site,) float64
            Result of :meth:`foveasim.Camera.angular_response`. Above 1, which light of other sites can cause, it is 1.

        Raises
        ------
        ParameterError
            When the response is not one number from 0 per site.
        """
        known = check_per_site("response", finite_array("response", response, at_least=0.0), self.layout.n_sites)
        return replace(self, sensitivity=np.minimum(known * self.sensitivity, 1.0), pixel_optics=None)

    def part(self, selection: OwnCheck[slice | Ints]) -> Sensor:
        """
        Return the sensor of some of the sites, with their fixed patterns and effects.

        Parameters
        ----------
        selection : slice or (n,) int
            Indices of the sites, in any order, which may be repeated.

        Raises
        ------
        ParameterError
            If effects, such as crosstalk, connect sites with others, or an index is not that of a site.
        """
        from foveasim.sensor.part import part_of

        return part_of(self, selection)

    @property
    def _own_collection(self) -> Collection | None:
        return next((effect for effect in self.effects if isinstance(effect, Collection)), None)

    @cached_property
    def collection(self) -> Collection:
        """
        Draw from expected to collected charge.

        With its name or "shot" in ``disabled``, the rounded mean.
        """
        found = self._own_collection or ShotNoise(self.shot_noise, self.gaussian_above_e)
        return found.without_draw() if {found.name, ShotNoise.name} & set(self.disabled) else found

    @cached_property
    def sites(self) -> Sites:
        """Photosites with device and sense-node capacitances, for effects."""
        return Sites(self.layout, self.device, self._given_f, _complete=self._complete_sites)

    @property
    def _given_f(self) -> Floats | None:
        """Capacitances of the sense nodes, (n_site,) or (1,) F; None for those by area."""
        if self.gain_dn_per_e is not None:
            gain = np.atleast_1d(np.asarray(self.gain_dn_per_e, np.float64))
            return read_only(self.adc.n_codes * ELEMENTARY_CHARGE_C / (gain * self.v_sat_v))
        return (
            None if self.capacitance_f is None else read_only(np.atleast_1d(np.array(self.capacitance_f, np.float64)))
        )

    @property
    def _complete_sites(self) -> tuple[Sites, slice | Ints] | None:
        """Sites of the sensor that this one is a part of, and the indices of its sites."""
        return None

    def effects_at(self, stage: Stage) -> list[Effect]:
        """Return the effects of a stage, in their order."""
        return [effect for effect in self.chain if effect.stage == stage]

    def pattern(self, name: str) -> Floats:
        """
        Return the fixed pattern of an effect on this device.

        Parameters
        ----------
        name : str
            Name of a fixed factor or offset, such as "prnu", or "rts".

        Returns
        -------
        pattern : (n_site,) or (1,) float64
            Factors, or offsets in the unit of the effect's stage; for "rts" half the difference between the two states, e-.

        Raises
        ------
        ParameterError
            If the sensor has no such effect.
        """
        patterns: dict[str, Floats] = {}
        for effect in self.chain:
            if isinstance(effect, FixedFactor | FixedOffset):
                patterns[effect.name] = self.sites.of(effect).pattern(effect, effect.pattern)
            elif (half_step := effect.half_step(self.sites.of(effect))) is not None:
                patterns[effect.name] = half_step
        if name not in patterns:
            hint = possible_names(name, list(patterns))
            raise ParameterError("name", "must be one of the sensor's fixed patterns", name, hint=hint)
        return patterns[name]

    @cached_property
    def response(self) -> Floats:
        """
        Relative photo response of each site, (n_site,) or (1,).

        Includes sensitivity, PRNU, dead sites and additional effects.
        """
        return self._fixed(self.sensitivity, "photo")

    def light_response(self, *, is_device_known: bool = True) -> Floats:
        """
        Compute the expected charge of each site per photoelectron of uniform light.

        Includes sensitivity and all effects before collection, crosstalk among them; not the dark signal.

        Parameters
        ----------
        is_device_known : bool
            Whether fixed patterns are those of the device; otherwise the response is the mean over all devices, without
            defects.

        Returns
        -------
        response : (n_site,) float64
        """
        return map_light(self._light_records(is_device_known), np.ones(self.layout.n_sites))

    def dark_response(self, exposure_s: Annotated[float, EXPOSURE]) -> Floats:
        """
        Compute the expected charge without light: mean over devices, without defects.

        Returns
        -------
        dark_e : (n_site,) float64, e-
        """
        return self._light_records(False, exposure_s)[-1].mean

    def _light_records(self, is_device_known: bool, exposure_s: float = 1.0) -> list[Record]:
        """Return the records from light to expected charge, without light."""
        sensor = self if is_device_known else self._without_defects
        sites = self.sites if is_device_known else self.sites.without_device()
        return light_records(sensor, sites, np.zeros(self.layout.n_sites), exposure_s)

    @cached_property
    def _without_defects(self) -> Sensor:
        """Sensor without defects, which shares its compiled effects."""
        found = self.without(*(effect.name for effect in self.chain if effect.is_defect))
        vars(found)["sites"] = self.sites
        return found

    @cached_property
    def dark_rate_e_per_s(self) -> Floats:
        """
        Dark current of each site at the sensor's temperature, (n_site,) or (1,) e-/s.

        Includes DSNU, hot sites and additional effects.
        """
        return self._fixed(self.nominal_dark_e_per_s, "dark")

    @property
    def nominal_dark_e_per_s(self) -> Floats:
        """Nominal dark current at the sensor's temperature, (n_site,) or (1,) e-/s."""
        return np.atleast_1d(np.asarray(self.dark_e_per_s, np.float64)) * self.dark_current_ratio

    def _fixed(self, values: PerSite | Floats, stage: Stage) -> Floats:
        """Return the values of all sites after the effects of a stage."""
        effects, values = self.effects_at(stage), np.atleast_1d(np.asarray(values, np.float64))
        if not effects:
            return read_only(values.copy())
        result = Save()
        run_steps((*effects, result), np.broadcast_to(values, self.layout.n_sites), sites=self.sites)
        return read_only(result.values)

    @property
    def dark_current_ratio(self) -> float:
        """Ratio of the dark current at ``temperature_k`` to that at ``dark_reference_k``."""
        return dark_current_factor(
            self.temperature_k,
            self.dark_reference_k,
            self.dark_law,
            doubling_k=self.dark_doubling_k,
            activation_ev=self.dark_activation_ev,
            diffusion_fraction=self.dark_diffusion_fraction,
        )

    @property
    def node_f(self) -> Floats:
        """Capacitance of the sense nodes, (n_site,) or (1,) F: as given, or by area."""
        return self.sites.capacitance_f

    @cached_property
    def v_per_e(self) -> Floats:
        """Nominal conversion gain at zero signal, (n_site,) or (1,) V/e-."""
        return read_only(electrons_to_volts(1.0, self.node_f))

    @cached_property
    def well_e(self) -> Floats:
        """Full well capacity in whole electrons, (n_site,) or (1,) e-; infinite without limit."""
        if self.full_well_e is None:
            return read_only(np.full(1, np.inf))
        return read_only(np.floor(np.atleast_1d(np.asarray(self.full_well_e, np.float64))))

    @cached_property
    def first_code_e(self) -> Floats:
        """Charge that raises the code of a dark site by one, without noise, (n_site,) or (1,) e-."""
        step_v = self.adc.width_at_dn(self.pedestal_v / self.v_sat_v) * self.v_sat_v / self.adc.n_codes
        return read_only(step_v / self.v_per_e)

    def are_saturated(self, electrons: Ints, code: NDArray[Any]) -> Bools:
        """Return which sites have a full well or the highest code, (n_site,)."""
        charges = as_numbers("electrons", electrons, keep_type=True)
        codes = as_numbers("code", code, keep_type=True)
        check_broadcast(well_e=self.well_e, electrons=charges, code=codes)
        return np.asarray((codes == 2**self.bits - 1) | (charges >= self.well_e))

    # -- charges and codes ----------------------------------------------------------------------------------------

    @cached_property
    def _before_exposure(self) -> tuple[Step, ...]:
        return merge_steps(
            (Factor(self.sensitivity), *self.effects_at("photo"), Offset(self.dark_rate_e_per_s)), self.sites
        )

    @cached_property
    def _after_collection(self) -> tuple[Step, ...]:
        steps: list[Step] = [*self.effects_at("charge"), Factor(self.v_per_e), *self.effects_at("sense_node")]
        if self.nonlinearity_fraction:
            steps.append(Nonlinearity(self.nonlinearity_fraction, self.v_sat_v))
        if self.pedestal_v:
            steps.append(Offset(self.pedestal_v))
        return merge_steps((*steps, *self.effects_at("output")), self.sites)

    def expected_electrons(
        self, photo_e_per_s: Floats, exposure_s: Annotated[float, EXPOSURE], *, n_threads: int | None = None
    ) -> Floats:
        """
        Compute the expected charge of each site for an exposure, (n_site,) e-.

        The charge consists of photoelectrons and dark signal, after charge diffusion.
        """
        photo, steps = self._exposure(photo_e_per_s, exposure_s)
        expected_e = Save()
        run_steps((*steps, expected_e), photo, sites=self.sites, n_threads=n_threads)
        return expected_e.values

    def exposure_for(
        self,
        photo_e_per_s: Floats,
        *,
        target: Annotated[float, TARGET] = AUTO_TARGET,
        percentile: Annotated[float, PERCENTILE] = AUTO_PERCENTILE,
        n_threads: int | None = None,
    ) -> float:
        """
        Return the exposure time that makes a bright site reach a fraction of its range.

        Parameters
        ----------
        photo_e_per_s : (n_site,) float64, e-/s
            Photoelectron rates: :meth:`foveasim.Camera.photoelectrons_per_s`.
        target : float
            Mean code, as a fraction of the range of a site from black to saturation, by the full well or by the ADC.
        percentile : float
            Percentile of the sites that has this fraction: at 99, 1 % of the sites are brighter.
        n_threads : int, optional
            Number of threads; all cores by default.

        Returns
        -------
        exposure_s : float, s
            To a relative accuracy of 1e-4, from the mean codes of :meth:`predict`.

        Raises
        ------
        ParameterError
            If no light reaches these sites, or no exposure time reaches the target.

        Examples
        --------
        A full well of 10,000 e- is filled to 70 % in 7 ms at 10⁶ e-/s:

        >>> import numpy as np
        >>> from foveasim.layout import grid
        >>> sensor = Sensor(
        ...     grid(n_x=4, n_y=4, pitch_um=2.0), full_well_e=1e4, capacitance_f=6e-16
        ... )
        >>> round(sensor.exposure_for(np.full(16, 1e6)), 5)
        0.007
        """
        photo_e_per_s = finite_array("photo_e_per_s", self._check_size("photo_e_per_s", photo_e_per_s), at_least=0.0)
        return exposure_for(self, photo_e_per_s, target, percentile, n_threads)

    def collect(
        self,
        expected_e: Floats,
        *,
        seed: int | None = None,
        frame: int = 0,
        exposure_s: Annotated[float | None, EXPOSURE] = None,
        n_threads: int | None = None,
        _streams: Streams | None = None,
    ) -> Ints:
        """
        Draw the collected charge, (n_site,) int64 e-: collection, then full well.

        Parameters
        ----------
        expected_e : (n_site,) float64, e-
            Expected charge from :meth:`expected_electrons`, or from another program.
        seed, frame : int
            Seed and frame number of the draws. Equal ones give bit-identical charges. ``seed`` is required unless nothing is
            drawn.
        exposure_s : float, optional, s
            Exposure time, for collections that depend on it (:attr:`~foveasim.sensor.effects.Collection.needs_exposure`).
        n_threads : int, optional
            Number of threads; all cores by default. Results do not depend on it.
        """
        expected_e = self._check_size("expected_e", expected_e)
        electrons, sites = Save(np.int64), self._sites_during(exposure_s)
        streams = _streams or self._streams(seed, frame, self._collection)
        run_steps((*self._collection, electrons), expected_e, sites=sites, streams=streams, n_threads=n_threads)
        return electrons.values

    def read(
        self,
        electrons: Ints,
        *,
        seed: int | None = None,
        frame: int = 0,
        n_threads: int | None = None,
        _streams: Streams | None = None,
        _reset_streams: Streams | None = None,
    ) -> NDArray[Any]:
        """
        Convert collected charges to digital codes, (n_site,) uint8 or uint16.

        The steps are effects on the charge, conversion to volts, nonlinearity, effects on the voltage, clipping at V_sat, and
        the ADC. For a linear ADC, code ``k`` covers the voltages from ``k * V_sat / 2**bits`` to
        ``(k + 1) * V_sat / 2**bits``.

        Parameters
        ----------
        electrons : (n_site,), e-
            Collected charge from :meth:`collect`, or from another program, in e- or fractions.
        seed, frame : int
            Seed and frame number of the draws. Equal ones give bit-identical codes. ``seed`` is required unless nothing is
            drawn.
        n_threads : int, optional
            Number of threads; all cores by default. Results do not depend on it.
        """
        electrons = self._check_size("electrons", electrons)
        conversion = self._conversion()
        steps = (ChargeCheck("electrons", -np.inf), *self._after_collection, conversion)
        streams = _streams or self._streams(seed, frame, steps)
        run_steps(
            steps, electrons, sites=self.sites, streams=streams, reset_streams=_reset_streams, n_threads=n_threads
        )
        return conversion.code

    def expose(
        self,
        photo_e_per_s: Floats,
        exposure_s: Annotated[float, EXPOSURE],
        *,
        seed: int | None = None,
        frame: int = 0,
        n_threads: int | None = None,
        _streams: Streams | None = None,
    ) -> tuple[Floats, Ints, NDArray[Any]]:
        """
        Simulate an exposure in one pass over the sites.

        The results are those of :meth:`expected_electrons`, :meth:`collect` and :meth:`read`.

        Parameters
        ----------
        photo_e_per_s : (n_site,) float64, e-/s
            Photoelectron rate, as from :meth:`foveasim.Camera.photoelectrons_per_s`, or from another program.
        exposure_s : float, s
        seed, frame : int
            Seed and frame number of the draws. Equal ones give bit-identical results. ``seed`` is required unless nothing is
            drawn.
        n_threads : int, optional
            Number of threads; all cores by default. Results do not depend on it.

        Returns
        -------
        expected_e : (n_site,) float64, e-
            Expected charge.
        electrons : (n_site,) int64, e-
            Collected charge.
        code : (n_site,) uint8 or uint16, DN
        """
        photo, before = self._exposure(photo_e_per_s, exposure_s)
        expected_e, electrons, conversion = Save(), Save(np.int64), self._conversion()
        steps = (*before, expected_e, *self._collection, electrons, *self._after_collection, conversion)
        streams = _streams or self._streams(seed, frame, steps)
        run_steps(steps, photo, sites=self._sites_during(exposure_s), streams=streams, n_threads=n_threads)
        return expected_e.values, electrons.values, conversion.code

    @staticmethod
    def _streams(seed: int | None, frame: int, steps: Iterable[Step]) -> Streams | None:
        """Return the random streams of a frame, None if no step draws numbers."""
        drawn = [step.name for step in steps if step.is_temporal and getattr(step, "is_drawn", True)]
        if seed is None and drawn:
            raise ParameterError("seed", f"must be given for the draws of {', '.join(map(repr, drawn))}")
        return None if seed is None else Streams(seed, frame)

    def _sites_during(self, exposure_s: float | None) -> Sites:
        """Return all sites with an exposure time, which some collections require."""
        if exposure_s is None and self.collection.needs_exposure:
            raise ParameterError("exposure_s", f"must be given: the collection '{self.collection.name}' depends on it")
        return self.sites.during(exposure_s)

    def _exposure(self, photo_e_per_s: Floats, exposure_s: float) -> tuple[Floats, tuple[Step, ...]]:
        """Return the rates of all sites, and the steps from them to the expected charges."""
        photo = np.asarray(unmasked("photo_e_per_s", photo_e_per_s))
        n_sites = self.layout.n_sites
        if photo.shape != (1,):
            check_per_site("photo_e_per_s", photo, n_sites, or_one=True)
        photo = np.broadcast_to(photo, n_sites)
        return photo, (*self._before_exposure, Factor(exposure_s), *self.effects_at("expected"))

    @cached_property
    def _collection(self) -> tuple[Step, ...]:
        """Steps from the expected to the collected charges."""
        steps: list[Step] = [ChargeCheck("expected_e", 0.0), self.collection]
        if self.full_well_e is not None:
            steps.append(FullWell(self.well_e))
        return tuple(steps)

    def _conversion(self) -> Conversion:
        """Return the conversion of voltages to codes, with a new array for the codes."""
        code = np.empty(self.layout.n_sites, np.uint8 if self.bits <= 8 else np.uint16)
        return Conversion(code, self._line, self._tables)

    @cached_property
    def _line(self) -> NDArray[np.int32]:
        """Readout line of each site, (n_site,), with DNL; otherwise one 0, (1,)."""
        return read_only(self.layout.readout_line.astype(np.int32) if self.dnl_dn else np.zeros(1, np.int32))

    @cached_property
    def _tables(self) -> ConversionTables:
        return self.adc.tables(self.v_sat_v, self.device.key("dnl")[0])

    @property
    def conversion_tables(self) -> tuple[NDArray[np.int32], ConversionTables]:
        """Readout lines and tables of the ADC, for kernels."""
        return self._line, self._tables

    def _check_size(self, name: str, charge_e: ArrayLike) -> NDArray[Any]:
        return check_per_site(name, np.asarray(unmasked(name, charge_e)), self.layout.n_sites)

    def validate_charges(self, name: str, charge_e: ArrayLike) -> Floats:
        """Return charges as an array (n_site,) float64, e-, after validation."""
        charges = np.ascontiguousarray(self._check_size(name, charge_e), np.float64)
        return ChargeCheck(name, 0.0).apply(charges, sites=self.sites, rng=None)

    def calibrate(
        self, *, exposure_s: float, flat_e: ArrayLike, n_frames: int, seed: int, **options: Any
    ) -> Calibration:
        """Simulate dark and flat frames, and calibrate: see :func:`foveasim.sensor.calibrate`."""
        from foveasim.sensor.calibration import calibrate

        return calibrate(self, exposure_s=exposure_s, flat_e=flat_e, n_frames=n_frames, seed=seed, **options)

    def invert_collection(
        self, charge_e: Floats, noise_e2: Floats | float = 0.0, exposure_s: Annotated[float | None, EXPOSURE] = None
    ) -> tuple[Floats, Floats]:
        """
        Estimate the expected charge of each site from its collected charge.

        Parameters
        ----------
        charge_e : (..., n_site) float64, e-
            Collected charges, such as those of :meth:`invert`.
        noise_e2 : (..., n_site) or number, e-²
            Variance of these charges due to the readout.
        exposure_s : float, optional, s
            Required by collections that depend on it.

        Returns
        -------
        expected_e : (..., n_site) float64, e-
            Charge before the collection with this mean after it; half a count below the limit of a collection that has one.
        variance_e2 : (..., n_site) float64, e-²
            For shot noise, the charge plus one: the posterior mean of the expected charge, plus ``noise_e2``. For another
            collection, its variance plus one plus ``noise_e2``, over the square of its slope.
        """
        charges, noise = as_broadcast(charge_e=charge_e, noise_e2=noise_e2)
        return invert_collection(self.collection, self._sites_during(exposure_s), charges, noise)

    def readout_model(
        self,
        mean_e: ArrayLike,
        variance_e2: ArrayLike = 0.0,
        *,
        is_reset: bool = True,
        is_device_known: bool = True,
    ) -> ReadoutModel:
        """
        Compute a first-order model of the readout at the mean charges, including noise.

        Parameters
        ----------
        mean_e, variance_e2 : (..., n_site) or number, e- and e-²
            Moments of the collected charges, such as those of :attr:`collection`.
        is_reset : bool
            Whether to include noise drawn at the reset, which cancels in differences of non-destructive reads.
        is_device_known : bool
            Whether the fixed patterns of the device are known; otherwise means over all devices are used instead.
        """
        sites = self.sites if is_device_known else self.sites.without_device()
        return readout_model(self, mean_e, variance_e2, sites, is_reset=is_reset)

    def linearise(
        self,
        expected_e: ArrayLike | None = None,
        *,
        photo_e_per_s: ArrayLike | None = None,
        exposure_s: Annotated[float | None, EXPOSURE] = None,
        is_device_known: bool = True,
    ) -> Linearisation:
        """
        Compute a first-order statistical model of the sensor at the mean of each site.

        Parameters
        ----------
        expected_e : (..., n_site), optional, e-
            Expected charge from :meth:`expected_electrons`. With ``exposure_s``, derivatives with respect to the light are
            known, too.
        photo_e_per_s : (n_site,) or number, optional, e-/s
            Photoelectron rate of each site, instead of the charge; requires ``exposure_s``.
        exposure_s : float, optional, s
        is_device_known : bool
            Whether the fixed patterns of the device are known constants; otherwise they are sources of noise over all devices
            of the kind, around their mean.

        Raises
        ------
        ParameterError
            Unless the charge or the rate is given; if a charge or a rate is negative.
        """
        sites = self._sites_during(exposure_s)
        sites = sites if is_device_known else sites.without_device()
        if (expected_e is None) == (photo_e_per_s is None):
            raise ParameterError("expected_e", "must be given, or 'photo_e_per_s', but not both")
        if photo_e_per_s is not None and exposure_s is None:
            raise ParameterError("exposure_s", "must be given with 'photo_e_per_s'")
        expected, photo = (
            None if values is None else _means(name, values, self.layout.n_sites)
            for name, values in (("expected_e", expected_e), ("photo_e_per_s", photo_e_per_s))
        )
        return linearise(self, sites, expected, photo, exposure_s)

    def linearise_without_defects(self, photo_e_per_s: Floats, exposure_s: float) -> Linearisation:
        """Compute :meth:`linearise` over all devices, without defects."""
        return self._without_defects.linearise(
            photo_e_per_s=photo_e_per_s, exposure_s=exposure_s, is_device_known=False
        )

    def invert(self, code: ArrayLike) -> Inverse:
        """
        Estimate the charge at the sense node of each site from codes, for the nominal sensor.

        Companding, INL, response nonlinearity and effects on voltages and charges are inverted at their mean over devices;
        effects that mix sites, the collection and differential nonlinearity are not.

        Parameters
        ----------
        code : (..., n_site), DN

        Returns
        -------
        Inverse
            Charges, with the variance of readout and conversion, and saturation.

        Raises
        ------
        ParameterError
            If a code is out of range.
        """
        codes = check_per_site("code", finite_array("code", code), self.layout.n_sites, or_rows=True)
        return invert(self, self.sites.without_device(), codes)

    def predict(
        self,
        expected_e: Floats,
        *,
        exposure_s: Annotated[float | None, EXPOSURE] = None,
        n_threads: int | None = None,
    ) -> tuple[Floats, Floats]:
        """
        Compute mean and temporal variance of each site's code analytically, for this device.

        Parameters
        ----------
        expected_e : (n_site,) float64, e-
            Expected charge from :meth:`expected_electrons`.
        exposure_s : float, optional, s
            Required by collections that depend on it.
        n_threads : int, optional
            Number of threads; all cores by default.

        Returns
        -------
        mean_dn, variance_dn2 : (n_site,) float64, DN and DN²
            Moments of the codes, including quantisation, clipping and the nonlinearities of the ADC.

        Notes
        -----
        Each code is weighted with the probability that the charge plus readout noise is between its transition levels. Charges
        are Poisson-distributed integers, clipped at the full well, for ``shot_noise="auto"`` and ``"exact"`` alike: draws of
        ``"auto"`` above ``gaussian_above_e`` have the same mean and variance, and cumulative probabilities that differ by at
        most 8e-5. Moments are those of the sums over all integers to 1e-9 DN and to 1e-9 of the variance. Where the readout
        noise is at least 1.1 e-, the steps of the cumulative probability vanish to 4e-11, and it is an Edgeworth series to the
        order that the charge requires, unless the full well or a small charge requires the integers. For a linear ADC without
        INL, DNL and clipping, moments are those before quantisation plus a Fourier series of the quantisation error.

        Readout effects are represented by their moments: to first order at the mean charge, with Gaussian temporal noise,
        except RTS noise, which has its two states. Charges of other sites that are mixed in after the draw, as by inter-pixel
        capacitance, are assumed to be Gaussian.
        A collection of a user has the sums over its probabilities (:meth:`~foveasim.sensor.effects.Collection.table`).
        """
        expected_e = self.validate_charges("expected_e", expected_e)
        return predict(self, expected_e, self._sites_during(exposure_s), n_threads=n_threads)

    def predict_covariance(
        self, expected_e: Floats, sites: ArrayLike, *, exposure_s: Annotated[float | None, EXPOSURE] = None
    ) -> Floats:
        """
        Compute the temporal covariance of the codes of some sites.

        Parameters
        ----------
        expected_e : (n_site,) float64, e-
            Expected charge of all sites.
        sites : (n,) int
            Indices of the sites.
        exposure_s : float, optional, s
            Required by collections that depend on it.

        Returns
        -------
        covariance : (n, n) float64, DN²

        Notes
        -----
        The diagonal is the variance of :meth:`predict`. Other elements are those of :meth:`linearise`, with the slope of the
        mean code over the noise instead of the local slope of the ADC. For Gaussian noise this is the first term of a series
        in the correlation with positive coefficients: a lower bound where codes are few, as for one bit, and the covariance
        where noise spans at least one code.
        """
        charges = self.validate_charges("expected_e", expected_e)
        return predict_covariance(self, charges, sites, self._sites_during(exposure_s), exposure_s)


def _means(name: str, values: ArrayLike, n_sites: int) -> Floats:
    """Return charges or rates (..., n_site) or (1,) after validation."""
    array = np.atleast_1d(as_numbers(name, values))
    if array.shape != (1,):
        check_per_site(name, array, n_sites, or_rows=True)
    if array.size and not (smallest := float(array.min())) >= 0.0:
        raise ParameterError(name, "must be >= 0 everywhere", smallest)
    return np.broadcast_to(array, (n_sites,)) if array.shape == (1,) else array
