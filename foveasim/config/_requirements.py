"""Results of a shot that files can name, and requirements, which limit them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from foveasim.errors import ParameterError
from foveasim.metrics.registry import METRICS, check_number_name, has_region, metric_info, options_of


def _number_names() -> list[str]:
    return [name for name in METRICS if metric_info(name).is_number]


def _check_name(name: str) -> str:
    """Check the name of a metric in a file."""
    try:
        return check_number_name("measure", name)
    except ParameterError as error:
        raise ValueError(error.detail) from None


#: Names of metrics that are one number, with those of installed packages.
MetricName = Annotated[
    str, AfterValidator(_check_name), Field(json_schema_extra=lambda schema: schema.update(enum=_number_names()))
]


@dataclass(frozen=True, kw_only=True)
class RegionResult:
    """
    A result of a shot, of all photosites or of some.

    Attributes
    ----------
    measure : str
        Name of a metric in :data:`foveasim.metrics.METRICS`, own ones included: ``"snr"``, the median ratio of signal to
        temporal noise, and ``"snr_db"`` in dB; ``"n_sites"``;
        ``"saturated_fraction"``; ``"mean_code_dn"``; ``"mtf"``, of the lens on the axis times the photosite of median area, at
        ``frequency_per_mm``; ``"psnr_db"``, of the reconstructed picture; ``"data_rate_gbit_per_s"`` of one lane;
        ``"violations"`` of the design rules; ``"smallest_size_um"``; ``"exposure_s"``.
    annulus_um : (inner, outer), µm, optional
        Distances of the centroids from the centre of the layout's bounding box.
    rectangle_um : (x0, y0, x1, y1), µm, optional
        Rectangle that contains the centroids, in sensor coordinates.
    site : int, optional
        Index of a photosite.
    frequency_per_mm : float, optional
        Spatial frequency on the sensor, of ``"mtf"``. At least 0 per mm.

    Raises
    ------
    ParameterError
        When the measure does not have the region or the frequency.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.config.RegionResult(
    ...     measure="mtf", frequency_per_mm=50.0, annulus_um=(0.0, 100.0)
    ... ).subject
    'MTF of lens and photosite at 50 per mm from 0 to 100 µm'
    """

    #: Unknown keys of files are errors.
    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    measure: MetricName
    annulus_um: tuple[float, float] | None = None
    rectangle_um: tuple[float, float, float, float] | None = None
    site: int | None = None
    frequency_per_mm: float | None = None

    def __post_init__(self) -> None:
        check_number_name("measure", self.measure)
        self._check_region()
        if self.frequency_per_mm is not None and not math.isfinite(self.frequency_per_mm):
            raise ParameterError("frequency_per_mm", "must be finite", self.frequency_per_mm)
        if (self.frequency_per_mm is not None) != ("frequency_per_mm" in options_of(METRICS[self.measure])):
            rule = "must be given if and only if the measure depends on it, as 'mtf' does"
            raise ParameterError("frequency_per_mm", rule, self.frequency_per_mm)
        if self.frequency_per_mm is not None and self.frequency_per_mm < 0.0:
            raise ParameterError("frequency_per_mm", "must be >= 0", self.frequency_per_mm, "per mm")

    def _check_region(self) -> None:
        """Check that there is at most one region, and that it is valid."""
        regions = [name for name in ("annulus_um", "rectangle_um", "site") if getattr(self, name) is not None]
        if len(regions) > 1:
            raise ParameterError(regions[1], f"excludes {regions[0]}", getattr(self, regions[1]))
        if regions and not has_region(self.measure):
            raise ParameterError(
                regions[0],
                f"must not be given: {self.measure} is a result of the complete sensor",
                getattr(self, regions[0]),
            )
        for name in ("annulus_um", "rectangle_um"):
            if not all(math.isfinite(value) for value in getattr(self, name) or ()):
                raise ParameterError(name, "must be finite", getattr(self, name), "µm")
        if self.annulus_um is not None and not 0.0 <= self.annulus_um[0] < self.annulus_um[1]:
            raise ParameterError("annulus_um", "must be two increasing radii >= 0", self.annulus_um, "µm")
        if self.rectangle_um is not None and not (
            self.rectangle_um[0] < self.rectangle_um[2] and self.rectangle_um[1] < self.rectangle_um[3]
        ):
            raise ParameterError(
                "rectangle_um", "must be (x0, y0, x1, y1) with x0 < x1 and y0 < y1", self.rectangle_um, "µm"
            )
        if self.site is not None and self.site < 0:
            raise ParameterError("site", "must be the index of a photosite, from 0", self.site)

    @property
    def has_region(self) -> bool:
        """Whether the result is for some of the photosites only."""
        return any(each is not None for each in (self.annulus_um, self.rectangle_um, self.site))

    @property
    def unit(self) -> str:
        """Unit of the result."""
        return metric_info(self.measure).unit

    @property
    def subject(self) -> str:
        """The result, in words."""
        parts = [metric_info(self.measure).title]
        if self.frequency_per_mm is not None:
            parts.append(f"at {self.frequency_per_mm:g} per mm")
        if self.annulus_um is not None:
            parts.append("from {:g} to {:g} µm".format(*self.annulus_um))
        if self.rectangle_um is not None:
            parts.append("in ({:g}, {:g}) to ({:g}, {:g}) µm".format(*self.rectangle_um))
        if self.site is not None:
            parts.append(f"of photosite {self.site:,}")
        return " ".join(parts)


@dataclass(frozen=True, kw_only=True)
class Requirement(RegionResult):
    """
    A condition on a result of a shot.

    Attributes
    ----------
    measure, annulus_um, rectangle_um, site, frequency_per_mm
        The result that is limited, as for :class:`RegionResult`.
    at_least, at_most : float, optional
        Limits in the unit of the result, at least one of them.

    Raises
    ------
    ParameterError
        When a limit is missing, or the measure does not have the region or the frequency.

    Examples
    --------
    >>> import foveasim as fs
    >>> print(
    ...     fs.config.Requirement(measure="snr", at_least=10.0, annulus_um=(400.0, 600.0))
    ... )
    signal-to-noise ratio from 400 to 600 µm: at least 10
    """

    at_least: float | None = None
    at_most: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.at_least is None and self.at_most is None:
            raise ParameterError("at_least", "or 'at_most' must be given")
        for name in ("at_least", "at_most"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ParameterError(name, "must be finite", value)
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            raise ParameterError("at_least", f"must be <= at_most, {self.at_most:g}", self.at_least)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        limits = [
            f"{word} {value:,.6g}{unit}"
            for word, value in (("at least", self.at_least), ("at most", self.at_most))
            if value is not None
        ]
        return f"{self.subject}: {' and '.join(limits)}"

    def margin(self, value: float) -> float:
        """
        Return the distance of a result from the nearest limit.

        Negative where the requirement is not met, or NaN.
        """
        margins = [value - self.at_least] if self.at_least is not None else []
        return min([*margins, self.at_most - value] if self.at_most is not None else margins)
