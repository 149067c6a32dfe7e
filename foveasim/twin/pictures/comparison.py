"""
Real frames beside simulated ones: what differs, and whether noise explains it.

Both are measured by the same functions of :mod:`foveasim.metrics`, on the same photosites and with the same number of frames,
so that their biases are equal. The light is matched by one factor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FRACTION, POSITIVE, Limits, OwnCheck
from foveasim._core.extras import import_optional
from foveasim._core.validation import Floats, Ints, finite_array, read_only
from foveasim.camera import Camera
from foveasim.errors import ParameterError
from foveasim.metrics.emva_intervals import CONFIDENCE
from foveasim.metrics.photon_transfer import draw_frames
from foveasim.metrics.slanted_edge import slanted_edge_mtf
from foveasim.scene import Scene
from foveasim.scene._illuminants import Illuminant
from foveasim.scene._scene import DISTANCE
from foveasim.scene.charts import PATCH_NAMES, patch_reflectance
from foveasim.sensor.limits import EXPOSURE
from foveasim.twin.frame_files import FirstRow
from foveasim.twin.pictures._deviations import SPATIAL, Deviation, DeviationTable, Pair, has_sites
from foveasim.twin.pictures._frames import Raster, check_unsaturated
from foveasim.twin.pictures._target_scenes import WAVES_NM, axis_um, check_slanted, edge_rates, painted_rates, white_of

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Deviation", "PictureComparison", "compare_with"]

Target = Literal["slanted_edge", "grey_steps", "colour_chart", "flat_field"]
#: Smallest number of sites of a patch and filter.
MIN_SITES = 20
#: Rings of the relative illumination, of equal width from the axis to the corner.
N_RINGS = 5
#: Rows and columns of the colour chart, and its first grey.
CHART_SHAPE, FIRST_GREY = (4, 6), 18
#: Rows of a table in a notebook, above which only deviations are shown.
MAX_ROWS = 40


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureComparison:
    """
    Result of :func:`compare_with`.

    Attributes
    ----------
    target : str
    deviations : tuple of Deviation
        All compared quantities.
    light_factor : float
        Light of the simulated scene, relative to the given scene or to a white of 1,000 lx.
    n_frames : int
        Number of real frames, and of simulated ones.
    confidence : float
        Probability that the intervals of all rows contain the true differences.
    notes : tuple of str
        How the quantities were measured.
    real_dn, simulated_dn : (n_y, n_x) float64, DN
        Mean frames, top row first; NaN where the scene of an edge was not simulated.
    curves : mapping of str to (x, y)
        Curves of the figure, ``"real"`` and ``"simulated"``, with the filter where there are several.
    axis_labels : (str, str)
        Quantities and units of the curves.
    """

    target: str
    deviations: tuple[Deviation, ...]
    light_factor: float
    n_frames: int
    confidence: float
    notes: tuple[str, ...]
    real_dn: Floats
    simulated_dn: Floats
    curves: Mapping[str, tuple[Floats, Floats]]
    axis_labels: tuple[str, str]

    def __repr__(self) -> str:
        n_outside = len(self.outside)
        return (
            f"PictureComparison({self.target}: {n_outside} of {len(self.deviations)} quantities deviate at "
            f"{100.0 * self.confidence:g} % confidence, light factor {self.light_factor:.4g})"
        )

    @property
    def outside(self) -> tuple[Deviation, ...]:
        """Deviations that noise does not explain."""
        return tuple(each for each in self.deviations if not each.is_within)

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per quantity, with the fields of :class:`Deviation`."""
        return [asdict(each) for each in self.deviations]

    def to_pandas(self) -> pd.DataFrame:
        """Return the table of :meth:`records`; its ``attrs`` contain the light factor and notes."""
        table = import_optional("to_pandas", "pandas").DataFrame(self.records())
        table.attrs = {"target": self.target, "light_factor": self.light_factor, "notes": list(self.notes)}
        return table

    def plot(self) -> NDArray[Any]:
        """
        Draw both pictures, the curves, and all differences in units of their intervals.

        Returns
        -------
        axes : (4,) array of matplotlib axes
            Of a new figure: real and simulated picture, curves, differences.
        """
        from foveasim.view import plot_curves, plot_image
        from foveasim.view.plots.figures import new_figure

        axes = new_figure((10.0, 7.5)).subplots(2, 2).ravel()
        n_y, n_x = self.real_dn.shape
        for ax, title, picture in zip(axes, ("real", "simulated"), (self.real_dn, self.simulated_dn), strict=False):
            plot_image(
                picture[::-1],
                (0, 0, n_x, n_y),
                "column",
                "row from the bottom",
                label="code / DN",
                colour_map="gray",
                ax=ax,
            )
            ax.set_title(title)
        plot_curves(self.curves, *self.axis_labels, marker="." if self.target != "slanted_edge" else "", ax=axes[2])
        relative = [2.0 * d.difference / max(d.high - d.low, math.ulp(0.0)) for d in self.deviations]
        colours = ["tab:blue" if d.is_within else "tab:red" for d in self.deviations]
        axes[3].scatter(range(len(relative)), relative, s=12.0, c=colours)
        axes[3].axhspan(-1.0, 1.0, alpha=0.15)
        axes[3].set(xlabel="row of the table", ylabel="difference / half width of its interval")
        return axes

    def _repr_html_(self) -> str:
        from foveasim.view.notebook import html_table

        shown = self.deviations if len(self.deviations) <= MAX_ROWS else self.outside
        rows = [list(asdict(each).values()) for each in shown]
        headings = [each.name.replace("_", " ") for each in fields(Deviation)]
        which = "" if len(shown) == len(self.deviations) else " The table contains only those that deviate."
        return html_table(f"{self!r}.{which} {' '.join(self.notes)}", headings, rows)


def compare_with(
    camera: Camera,
    frames: OwnCheck[Any],
    target: Target,
    *,
    exposure_s: Annotated[float, EXPOSURE],
    regions: OwnCheck[Sequence[Sequence[float]] | None] = None,
    corners: OwnCheck[Sequence[Sequence[float]] | None] = None,
    gap_fraction: Annotated[float, FRACTION] = 0.0,
    reflectance: ArrayLike | None = None,
    dark: OwnCheck[Any] = None,
    noise: Literal["temporal", "spatial"] | None = None,
    first_row: FirstRow | None = None,
    scene: Scene | None = None,
    light_factor: Annotated[float | None, POSITIVE] = None,
    illuminant: Illuminant = "D65",
    distance_m: Annotated[float, DISTANCE] = 1.0,
    seed: Annotated[int, Limits(at_least=0)] = 0,
) -> PictureComparison:
    """
    Compare real frames of a target with the simulated ones of a camera.

    Parameters
    ----------
    camera : Camera
        With a regular sensor: photosites in complete rows and columns.
    frames : (n_frame, n_y, n_x) or (n_y, n_x) numbers, path, or list of either
        Codes of the photosites, of mosaics without demosaicing: arrays, or TIFF, PNG, npy or FITS files. Several frames of
        an unchanged scene are necessary for the temporal noise.
    target : {"slanted_edge", "grey_steps", "colour_chart", "flat_field"}
    exposure_s : float, s
        Exposure time of the frames.
    regions : sequence of (x0, y0, x1, y1), pixels
        Rectangle around an edge, or around each grey step: columns x0 to x1 - 1 and rows y0 to y1 - 1 of the given arrays.
    corners : (4, 2) float, pixels
        Outer corners (x, y) of the 24 patches of a ColorChecker, or of a row of equal grey steps, clockwise in the upright
        picture: from dark skin to bluish green, black and white, or from the first step along the row. (0, 0) is the outer
        corner of the first pixel of the given arrays.
    gap_fraction : float
        With corners, width of the black gaps between patches, relative to the side of a patch. Above 0, the surround is black,
        too; otherwise it has the light of the nearest patch. It matters for stray light only.
    reflectance : (n_step,)
        Reflectances of the grey steps, from 0 to 1.
    dark : as ``frames``, optional
        Dark frames of the same exposure, for the black level and the dark noise. Without them, the black level of the simulated
        sensor is subtracted from real codes, too.
    noise : {"temporal", "spatial"}, optional
        Noise of patches: between frames, or between the sites of the first frame, with fixed patterns and shading. By default
        temporal for several frames, and spatial for one.
    first_row : {"top", "bottom"}, optional
        Which row of the upright picture is the first one in the arrays. By default the top row, and the bottom row in FITS
        files without ``ROWORDER = 'TOP-DOWN'``.
    scene : Scene, optional
        Light of the target, instead of the edge, patches or field that are simulated by default.
    light_factor : float, optional
        Factor of the light of the scene. By default the one for which the mean signal of the target is that of the
        frames: of the edge, of all patches, or of the centre of the field.
    illuminant : {"A", "D50", "D55", "D65", "D75", "E"}
        CIE illuminant of the default scenes, from 400 to 700 nm.
    distance_m : float, m
        Distance of the default scenes.
    seed : int
        Seed of the simulated noise.

    Returns
    -------
    PictureComparison

    Raises
    ------
    ParameterError, FileError
        When frames do not have the shape or the codes of the sensor, patches are saturated or too small, or corners are outside
        the picture or in the wrong order.
    SimulationError
        When a region contains no straight edge, or one parallel to rows of photosites.

    Notes
    -----
    The quantities are the MTF of the edge at fractions of the Nyquist frequency and MTF50; mean code, noise and system gain of
    grey patches; CIELAB and colour errors (CIE 2000) of the colour chart; and the relative illumination of the flat field in
    rings around the optical axis. Default scenes reproduce what the frames show: an edge at the same place, with the angle and
    contrast of the real one, or patches of known reflectance at the same places.

    Colours have the white balance of their own greys (neutral 8 to 3.5), and then one 3 x 3 matrix for both: the colour
    correction of the simulated camera. The system gain is the slope of the temporal variance against the mean of the
    patches, with relative weights.

    Intervals are simultaneous: with a probability of 95 %, all of them contain the true differences (Bonferroni), so that equal
    cameras have no row outside in 95 % of comparisons. Those of the MTF follow from its standard deviation, all others from
    the jackknife over blocks of photosites, where both cameras leave out the same ones. They are statistical: fixed patterns
    that many sites share, as of columns, and errors of reflectances are not included.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(64, 64, 4.0), capacitance_f=1.6e-15, v_sat_v=1.0, bits=12
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor
    ... )
    >>> rng = np.random.default_rng(0)  # frames of a camera without read noise
    >>> frames = np.rint(0.41 * rng.poisson(5000.0, (4, 64, 64)))
    >>> found = camera.compare_with(frames, "flat_field", exposure_s=0.01)
    >>> [(row.quantity, row.is_within) for row in found.deviations[:2]]
    [('mean code', True), ('temporal noise', True)]
    """
    sensor, n_sites = camera.sensor, camera.layout.n_sites
    raster = Raster.of(camera.layout, sensor.bits)
    real, order = raster.codes("frames", frames, first_row)
    unlit = None if dark is None else raster.codes("dark", dark, first_row)[0]
    for name, codes in (("frames", real), ("dark", real if unlit is None else unlit)):
        if noise == "temporal" and len(codes) < 2:
            raise ParameterError(
                name, "must be several frames for the temporal noise, got one", hint="or use noise='spatial'"
            )
    steps = _steps(target, reflectance)
    measured, painted = _patches(camera, target, raster, order, regions, corners, gap_fraction, len(steps))
    check_unsaturated(real, measured, sensor.bits)

    dark_e = sensor.expected_electrons(np.zeros(n_sites), exposure_s)
    draw = partial(draw_frames, sensor, seed=seed, exposure_s=exposure_s, n_threads=camera.n_threads)
    darks = None
    if unlit is not None:
        darks = Pair(unlit, draw(dark_e, n_frames=len(unlit), first_frame=len(real)))
    black_dn = 0.0 if darks is None else float(darks.real.mean() - darks.simulated.mean())

    def light_e(codes: NDArray[Any], black_dn: float = 0.0) -> Floats:
        """Return the charges above the dark signal, by the nominal sensor."""
        mean_dn = np.clip(codes.mean(axis=0, dtype=np.float64) - black_dn, 0.0, 2**sensor.bits - 1)
        return np.asarray(sensor.invert(mean_dn).charge_e - dark_e)

    real_e, used = light_e(real, black_dn), measured >= 0
    if scene is None:
        white = white_of(illuminant)
        if target == "slanted_edge":
            most = int(np.bincount(sensor.filter_of_site[used]).argmax())
            edge = slanted_edge_mtf(camera.layout, real_e, where=used & (sensor.filter_of_site == most))
            check_slanted(camera, used, edge)
            rate_e_per_s = edge_rates(camera, used, edge, white, distance_m)
        else:
            weights, spectra = {
                "flat_field": (np.ones((1, 1)), white[np.newaxis]),
                "grey_steps": (steps[np.newaxis], white[np.newaxis]),
                "colour_chart": (np.eye(len(PATCH_NAMES)), patch_reflectance(WAVES_NM) * white),
            }[target]
            scene, rate_e_per_s = painted_rates(camera, raster.sites, painted, weights, spectra, white, distance_m)
    else:
        rate_e_per_s = camera.photoelectrons_per_s(scene)
    notes = [f"The light factor is {'that of equal mean signals' if light_factor is None else 'given'}."]
    if light_factor is None:
        matched = measured == 0 if target == "flat_field" else used
        lit_e = sensor.expected_electrons(rate_e_per_s, exposure_s) - dark_e
        light_factor = _matched(real_e[matched], lit_e[matched])
    simulated = draw(sensor.expected_electrons(light_factor * rate_e_per_s, exposure_s), n_frames=len(real))
    pair, charges = Pair(real, simulated), Pair(real_e, light_e(simulated))

    table = DeviationTable(camera, has_temporal=noise != "spatial")
    if darks is None:
        notes.append("The black level is that of the simulated sensor.")
    else:
        every = np.zeros(n_sites, np.int64)
        table.add_signals(darks, every, [""], ("black level", f"{table.noise_of(darks)} in the dark"))
    if target == "colour_chart":
        table.add_colours(charges, measured, scene, illuminant)
        notes.append("Colours are balanced on their greys and corrected by the matrix of the simulated camera.")
    if target == "slanted_edge":
        curves = table.add_edges(charges, used)
        axis_labels = "frequency / (line pairs per mm)", "MTF"
    elif target == "flat_field":
        table.add_signals(pair, np.where(measured == 0, 0, -1), ["centre"])
        curves = table.add_rings(charges, measured)
        axis_labels = "ring from the optical axis", "relative illumination"
    else:
        names = [f"patch {k}" for k in range(len(steps))] if target == "grey_steps" else PATCH_NAMES
        greys = measured if target == "grey_steps" else np.where(measured >= FIRST_GREY, measured, -1)
        curves = table.add_signals(pair, greys, names, darks=darks)
        axis_labels = "mean code / DN", f"{table.noise_of(pair)} / DN"
    simulated_dn = simulated.mean(axis=0)
    if target == "slanted_edge" and scene is None:
        simulated_dn[rate_e_per_s == 0.0] = np.nan
    if table.noise_of(pair) == SPATIAL and target != "slanted_edge":
        notes.append("The noise is spatial, within patches of one frame, with their fixed pattern and shading.")
    return PictureComparison(
        target=target,
        deviations=table.deviations(),
        light_factor=light_factor,
        n_frames=len(real),
        confidence=CONFIDENCE,
        notes=tuple(notes),
        real_dn=read_only(real.mean(axis=0)[raster.sites]),
        simulated_dn=read_only(simulated_dn[raster.sites]),
        curves=curves,
        axis_labels=axis_labels,
    )


def _steps(target: Target, reflectance: ArrayLike | None) -> Floats:
    """Return the reflectances of grey steps; those of other targets are not given."""
    if target != "grey_steps":
        if reflectance is not None:
            raise ParameterError("reflectance", f"must be given for 'grey_steps' only, got it for {target!r}")
        return np.ones(0)
    if reflectance is None:
        raise ParameterError("reflectance", "must be given for grey steps, one number per step")
    steps = finite_array("reflectance", reflectance, ndim=1, at_least=0.0, at_most=1.0)
    if steps.size < 2 or not steps.any():
        raise ParameterError("reflectance", "must be those of at least two steps, not all 0", reflectance)
    return steps


def _patches(
    camera: Camera,
    target: Target,
    raster: Raster,
    order: FirstRow,
    regions: Sequence[Sequence[float]] | None,
    corners: Sequence[Sequence[float]] | None,
    gap_fraction: float,
    n_steps: int,
) -> tuple[Ints, Ints]:
    """Return the measured and the simulated patch of each site, (n_site,), -1 for none."""
    allowed = {"slanted_edge": ("regions",), "grey_steps": ("regions", "corners"), "colour_chart": ("corners",)}
    given = [name for name, value in (("regions", regions), ("corners", corners)) if value is not None]
    for name in given:
        if name not in allowed.get(target, ()):
            raise ParameterError(name, f"must not be given for {target!r}")
    if target in allowed and len(given) != 1:
        rule = f"must be given for {target!r}" if not given else "must not be given together with 'regions'"
        raise ParameterError("corners" if given else allowed[target][-1], rule)
    if target == "flat_field":
        radius_um = np.hypot(*(camera.layout.centroid_um - axis_um(camera)).T)
        measured: Ints = np.minimum(N_RINGS * radius_um / radius_um.max(), N_RINGS - 1).astype(np.int64)
        painted: Ints = np.zeros_like(measured)
    elif corners is not None:
        shape = CHART_SHAPE if target == "colour_chart" else (1, n_steps)
        measured, painted = raster.chart(camera, corners, shape, gap_fraction, order)
    else:
        assert regions is not None
        measured = painted = raster.regions(regions, order)
    n_patches = {"slanted_edge": 1, "grey_steps": n_steps, "colour_chart": len(PATCH_NAMES), "flat_field": N_RINGS}
    if regions is not None and len(regions) != n_patches[target]:
        raise ParameterError("regions", f"must be {n_patches[target]} of them for {target!r}", len(regions))
    n_filters = camera.sensor.n_filters
    used = measured >= 0
    sizes = np.bincount(
        measured[used] * n_filters + camera.sensor.filter_of_site[used], minlength=n_patches[target] * n_filters
    )
    smallest = sizes.reshape(n_patches[target], n_filters)[:, has_sites(camera)].min()
    if smallest < MIN_SITES:
        name = given[0] if given else "camera"
        rule = f"must have at least {MIN_SITES} photosites of each filter in each patch"
        raise ParameterError(name, rule, int(smallest), hint="use larger patches")
    return measured, painted


def _matched(real_e: Floats, lit_e: Floats) -> float:
    """Return the factor of the light with which the sums of both signals are equal."""
    factor = float(real_e.sum() / lit_e.sum()) if lit_e.sum() > 0.0 else 0.0
    if not factor > 0.0:
        hint = "check the black level with 'dark' frames"
        raise ParameterError("frames", "must contain light of the target, above the black level", hint=hint)
    return factor
