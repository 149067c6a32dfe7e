"""Camera as a PyTorch module, from scenes to expected charges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor, nn

from foveasim._io.mapped_files import in_memory
from foveasim.camera import Camera
from foveasim.camera._footprints import placed
from foveasim.errors import ParameterError, SamplingWarning, warn
from foveasim.fields import Grid
from foveasim.integrate import Integrator, UndistortedOutlines
from foveasim.learn._tensors import Constants, Parts, SparseMap, check_tensor, checked_gazes, constant, in_parts
from foveasim.learn.distortion import coefficient_names, coefficient_values, undistort, with_coefficients
from foveasim.learn.imaging import VARIABLES as LENS_VARIABLES
from foveasim.learn.imaging import Imaging, Origin, _check_variables, interleaved
from foveasim.learn.integral import site_power
from foveasim.learn.mesh import Mesh
from foveasim.learn.outlines import Outlines
from foveasim.learn.readout import Readout
from foveasim.scene import Scene
from foveasim.sensor import ConstantCurve, FilterSet, TableCurve
from foveasim.sensor.limits import EXPOSURE
from foveasim.units import photon_energy_j, w_from_w_m2_um2

__all__ = ["VARIABLES", "Model", "capture"]

#: Error of photosites above which shifted images cause a warning.
MAX_SHIFT_ERROR = 1e-2
#: Variables of a camera.
VARIABLES = ("vertices", *LENS_VARIABLES, "distortion", "filters", "qe", "exposure_s")


class Model(nn.Module):
    """
    Camera with gradients.

    Parameters
    ----------
    camera : Camera
        Initial values.
    scene : Scene
        Geometry and spectrum of the scenes; the default of :meth:`forward`.
    wrt : iterable of str
        Variables: ``"vertices"`` of the photosites; ``"zernike"``, ``"seidel"``, ``"defocus"`` and ``"pupil"`` as for
        :class:`Imaging`; ``"distortion"``, coefficients of the lens model; ``"filters"`` and ``"qe"``, transmissions
        and quantum efficiency at the wavelengths of the scene; ``"exposure_s"``.
    exposure_s : float, s
    boundary : {"fixed", "sliding", "free"}
        As for :class:`Mesh`.

    Attributes
    ----------
    mesh : Mesh
        Of the layout; with pixel optics of the outlines in which sites collect light, which are constants.
    imaging : Imaging
    readout : Readout
    distortion : Parameter (n_coefficient,)
        Coefficients of the lens model that are numbers, in the order of ``distortion_names``.
    filters : Parameter (n_filter, n_wavelength)
    qe : Parameter (n_filter, n_wavelength)
        Quantum efficiency, one row per filter.
    exposure_s : Parameter (), s

    Raises
    ------
    ParameterError
        When a variable is unknown or absent from the camera, or is ``"vertices"`` for a sensor with pixel optics.

    Examples
    --------
    ::

        model = fs.learn.Model(camera, scene, wrt=("vertices", "zernike"), exposure_s=0.01)
        optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
        for _ in range(100):
            optimiser.zero_grad()
            loss(model()).backward()
            optimiser.step()
            model.mesh.limit_step()
        improved = model.camera()
    """

    filters: Tensor
    qe: Tensor
    exposure_s: Tensor
    distortion: Tensor

    def __init__(
        self,
        camera: Camera,
        scene: Scene,
        wrt: Iterable[str] = ("vertices",),
        *,
        exposure_s: Annotated[float, EXPOSURE],
        boundary: Literal["fixed", "sliding", "free"] = "fixed",
    ) -> None:
        super().__init__()
        self.wrt: tuple[str, ...] = _check_variables("wrt", wrt, VARIABLES)
        self._camera, self._scene = camera, camera.light_at_gaze(scene)
        if scene.panorama is not None or self._scene.projection != "rectilinear":
            raise ParameterError(
                "scene", "must be a plane for sensor layers: they have no derivatives of panoramas", scene
            )
        self._boundary: Literal["fixed", "sliding", "free"] = boundary
        sensor = camera.sensor
        self.imaging: Imaging = Imaging(
            camera.optics, self._scene, [name for name in self.wrt if name in LENS_VARIABLES]
        )
        self.grid: Grid = camera.sensor_frame(self._scene).image(self.imaging.grid)
        self.order = camera.order(self._scene)
        self._cell_error = camera.optics.auto_oversample_error(self._scene)
        self._footprints = camera.footprints(scene)
        if self._footprints is not None and "vertices" in self.wrt:
            raise ParameterError(
                "wrt",
                "must not contain 'vertices' for a sensor with pixel optics, whose response and outlines are constants; remove "
                "'pixel_optics' from the sensor",
            )
        depends = sensor.collection.needs_exposure
        if depends and "exposure_s" in self.wrt:
            raise ParameterError(
                "wrt",
                f"must not contain 'exposure_s': the collection '{sensor.collection.name}' of the sensor depends on it",
            )
        self.readout: Readout = Readout(sensor, float(exposure_s) if depends else None)
        wave_nm = self._scene.wavelength_nm
        product = sensor.responsivity_e_per_j(wave_nm) * photon_energy_j(wave_nm)
        filters = sensor.filter_transmission(wave_nm)
        qe = np.divide(product, filters, out=np.zeros_like(product), where=filters > 0.0)
        self.distortion_names: tuple[str, ...] = ()
        if camera.distortion is not None:
            self.distortion_names = coefficient_names(camera.distortion)
        elif "distortion" in self.wrt:
            raise ParameterError("wrt", "must not contain 'distortion' for a camera without distortion")
        for name, value in (
            ("filters", filters),
            ("qe", qe),
            ("exposure_s", float(exposure_s)),
            ("distortion", coefficient_values(camera.distortion, self.distortion_names) if camera.distortion else []),
        ):
            if name in self.wrt:
                setattr(self, name, nn.Parameter(constant(value)))
            else:
                self.register_buffer(name, constant(value))
        self._used = sensor.filters_used.tolist()
        self._constants = Constants(
            photons_per_j=1.0 / photon_energy_j(wave_nm),
            # Of each site among those of the first filter, then the second, ...
            position_of_site=np.argsort(np.argsort(sensor.filter_of_site, kind="stable")),
        )
        if self._footprints is not None:
            self._constants.add(factor=self._footprints.factor, area_ratio=self._footprints.area_ratio)
        mixing = None if self._footprints is None else self._footprints.mixing
        self._mixing = None if mixing is None else SparseMap(mixing)
        self._moving: _MovingSites | None = None
        self._matrices: list[SparseMap] = []
        if {"vertices", "distortion"} & set(self.wrt):
            self._moving = _MovingSites(self.mesh, camera, self.grid)
        else:
            weights = self._integrator().weights()
            if not self.imaging.has_patches:
                weights = _on_columns(weights, self.grid.shape[1], *self.imaging.padded_columns)
            self._matrices = [SparseMap(weights[np.flatnonzero(sensor.filter_of_site == c)]) for c in self._used]
        self._n_constants = 0
        if not {*LENS_VARIABLES, "filters", "qe"} & set(self.wrt):
            with torch.no_grad():
                found = [interleaved(each).numpy() for each in self._transfer()]
            self._constants.add(**{f"transfer {k}": each for k, each in enumerate(found)})
            self._n_constants = len(found)

    def __getattr__(self, name: str) -> Any:
        if name == "mesh" and "mesh" not in self._modules:  # built on its first use
            layout: Any = placed(self._camera.layout, self._footprints, (0.0, 0.0))
            self.mesh = Mesh(layout, self._boundary).requires_grad_("vertices" in self.wrt)
            return self.mesh
        return super().__getattr__(name)

    def __repr__(self) -> str:
        return f"Model({self._camera!r}, variables: {', '.join(self.wrt)})"

    @property
    def n_sites(self) -> int:
        """Number of photosites."""
        return self._camera.layout.n_sites

    def _integrator(self) -> Integrator:
        """Return the layout compiled for the grid of the maps."""
        return self._camera.integrator(self.grid, order=self.order, footprints=self._footprints)

    def points(self) -> Tensor:
        """Return the points of the outlines in the plane of the maps, (n_point, 2) tensor, µm."""
        if self._moving is None:
            self._moving = _MovingSites(self.mesh, self._camera, self.grid)
        return self._moving.points(self.mesh(), self.distortion, self.distortion_names)

    def transfer(self, like: Tensor) -> list[Tensor]:
        """
        Compute the transfer functions from basis images to maps of photoelectrons.

        Parameters
        ----------
        like : tensor
            Basis images: constants have their device and precision.

        Returns
        -------
        list of (n_filter, n_image, n_row, n_column) tensors
            As of :meth:`Imaging.transfer`, for the filters that sites have; constants unless filters or optics are variables.
        """
        if not self._n_constants:
            return self._transfer()
        return [self._constants.get(f"transfer {k}", like) for k in range(self._n_constants)]

    def _transfer(self) -> list[Tensor]:
        e_per_j = self.filters[self._used] * self.qe[self._used]
        return self.imaging.transfer(e_per_j * self._constants.get("photons_per_j", e_per_j))

    def photo_e_per_s(
        self, basis: Tensor | None = None, gaze_um: Tensor | None = None, *, origin: Origin = "lower"
    ) -> Tensor:
        """
        Compute the expected photoelectrons of each site per second.

        Parameters
        ----------
        basis : (..., n_basis, n_y, n_x) tensor, optional
            Basis images of scenes; by default those of the scene.
        gaze_um : (..., 2) or (..., n_gaze, 2) tensor, optional, µm
            Gaze for each scene, or a path of gazes, in addition to that of the camera: see :class:`SensorLayer`.
        origin : {"lower", "upper"}
            Position of the first row of the basis images.

        Returns
        -------
        (..., n_site) or (..., n_gaze, n_site) tensor, e-/s
            On the device and with the dtype of the basis images; float64 for those of the scene.
        """
        if basis is None:
            basis = torch.from_numpy(np.array(in_memory(self._scene.basis), np.float64)).to(self.exposure_s.device)
        if not isinstance(basis, Tensor) or basis.ndim < 3:
            check_tensor("basis", basis, self._scene.basis.shape, any_device=True)
        shift = None if gaze_um is None else self._shift(basis, gaze_um)
        transfer, flat = self.transfer(basis), basis.reshape(-1, *basis.shape[-3:])
        check_tensor("basis", flat, (None, *self._scene.basis.shape), ", as the scene", any_device=True)
        is_padded = bool(self._matrices) and not self.imaging.has_patches

        def integrated(part: Tensor, shift: Tensor | None) -> Tensor:
            maps = self.imaging.outputs(part, transfer, shift, origin=origin, is_padded=is_padded)
            return self._integrated(maps).reshape(-1, 1 if shift is None else shift.shape[1], self.n_sites)

        shape = basis.shape[:-3] if gaze_um is None else gaze_um.shape[:-1]
        if 0 in shape:
            return basis.new_zeros(*shape, self.n_sites)
        found = in_parts(integrated, self.parts(flat, shift), flat, shift)
        return self._collect(found.reshape(*shape, self.n_sites) * float(w_from_w_m2_um2(1.0)))

    def overlaps(self, like: Tensor) -> list[Tensor]:
        """
        Return the overlaps of sites that do not move with the cells of maps.

        Returns
        -------
        list of (n, n_cell) sparse CSR tensors, µm²
            For the sites of each filter, on the device and with the dtype of another tensor; cells in the columns of
            :attr:`Imaging.padded_columns`, or of the maps for isoplanatic patches.
        """
        return [matrix.tensor(like) for matrix in self._matrices]

    def parts(self, scenes: Tensor, gazes: Tensor | None = None) -> Parts:
        """Return the parts of a batch that are computed at once; (n_scene, n_gaze, 2) gazes."""
        if not self._matrices:  # sites that move are compiled for all maps of the batch
            return Parts()
        return self.imaging.split(scenes, 1 if gazes is None else gazes.shape[1])

    def _integrated(self, maps: Iterable[Tensor]) -> Tensor:
        """Return the integrals (n_scene, n_site) of the maps of each filter over its sites."""
        points = None if self._moving is None or self._matrices else self.points()
        powers = []
        for k, of_filter in enumerate(maps):
            if points is None:
                powers.append(self._matrices[k].apply(of_filter.flatten(-2)))
            else:
                assert self._moving is not None
                powers.append(site_power(points, of_filter, self._moving.outlines_of[k], self.grid, order=self.order))
        if len(powers) == 1:
            return powers[0]
        return torch.cat(powers, dim=-1).index_select(-1, self._constants.get("position_of_site", powers[0]))

    def _shift(self, basis: Tensor, gaze_um: Tensor) -> Tensor:
        """Return gazes in cells of the maps, (n_scene, n_gaze, 2)."""
        gazes_um = checked_gazes(gaze_um, basis.shape[:-3])
        if gaze_um.device != basis.device:
            raise ParameterError(
                "gaze_um", f"must be on the device of the pictures, {basis.device}, got {gaze_um.device}"
            )
        camera = self._camera
        if camera.axis == "image" and camera.distortion is not None:
            raise ParameterError(
                "gaze_um",
                "must be that of the camera for a lens model, whose distortion stays with the image; use Camera(axis='sensor')",
            )
        if camera.axis == "sensor" and not self.imaging.is_invariant:
            raise ParameterError(
                "gaze_um",
                "must be that of the camera for axis='sensor', unless irradiance and PSF are equal everywhere; use "
                "axis='image', or an even Optics(relative_illumination=...)",
            )
        if self.imaging.has_patches:
            raise ParameterError(
                "gaze_um", "must be that of the camera with isoplanatic patches: set field_patches=None"
            )
        if self._footprints is not None:
            raise ParameterError("gaze_um", "must be that of the camera with pixel optics: create one layer per gaze")
        if self._cell_error > MAX_SHIFT_ERROR and not torch.compiler.is_compiling():
            warn(
                "the cells of the map are too coarse for the finest details of the image, so that shifted images ring at "
                f"edges: errors up to {100.0 * self._cell_error:.2g} % for gazes between cells; use Optics(oversample=...), "
                'source_pixel="square", or a scene with finer pixels',
                SamplingWarning,
            )
        return gazes_um.to(basis) / self.grid_pitch_um(basis)

    def grid_pitch_um(self, like: Tensor) -> Tensor:
        """Return the pitch of the maps along x and y, (2,) µm, as a tensor like another one."""
        return self._constants.get("pitch_um", like, lambda: self.grid.pitch_xy_um)

    def _collect(self, rates: Tensor) -> Tensor:
        """Return the rates that the sites collect through pixel optics, (..., n_site)."""
        if self._footprints is None:
            return rates
        collected = rates * self._constants.get("factor", rates)
        if self._mixing is None:
            return collected
        return collected + self._mixing.apply(rates / self._constants.get("area_ratio", rates))

    def forward(self, basis: Tensor | None = None, gaze_um: Tensor | None = None) -> Tensor:
        """
        Compute the expected charge of each site.

        Parameters
        ----------
        basis, gaze_um : optional
            As for :meth:`photo_e_per_s`.

        Returns
        -------
        (..., n_site) tensor, e-
            ``model.readout`` draws charges and computes codes from them.
        """
        rates = self.photo_e_per_s(basis, gaze_um)
        return self.readout.expected_e(rates, self.exposure_s.to(rates.dtype))

    def camera(self) -> Camera:
        """
        Return the camera with the current values of all variables.

        Values of the sensor that depend on the area of photosites are those of the initial layout.

        Raises
        ------
        GeometryError
            When an outline intersects itself.
        ParameterError
            When a value is out of range, such as a transmission above 1.
        """
        sensor, lens = self._camera.sensor, self._camera.distortion
        changes: dict[str, Any] = {}
        if "vertices" in self.wrt:
            changes["layout"] = self.mesh.layout()
        if "filters" in self.wrt or "qe" in self.wrt:
            wave_nm = self._scene.wavelength_nm
            curves = (self.filters * self.qe).detach().double().cpu().numpy()
            if not (np.isfinite(curves).all() and curves.min() >= 0.0 and curves.max() <= 1.0):
                raise ParameterError(
                    "filters",
                    "times 'qe' must be from 0 to 1",
                    curves,
                    hint="clamp them after each step of the optimiser",
                )
            changes["filters"] = FilterSet([_curve(wave_nm, row) for row in curves], sensor.filter_names)
            changes["qe"] = 1.0
        if lens is not None:
            lens = with_coefficients(lens, self.distortion_names, self.distortion.detach().double().cpu().numpy())
        return Camera(
            optics=self.imaging.optics(),
            sensor=replace(sensor, **changes),
            distortion=lens,
            order=self.order,
            gaze_um=self._camera.gaze_um,
            axis=self._camera.axis,
        )


def _on_columns(weights: Any, n_x: int, n_columns: int, first: int) -> Any:
    """Return a matrix for the cells of maps with further columns."""
    found = weights.tocoo()
    row, column = np.divmod(np.asarray(found.col, np.int64), n_x)
    shape = found.shape[0], found.shape[1] // n_x * n_columns
    return csr_array((found.data, (found.row, row * n_columns + first + column)), shape=shape)


class _MovingSites:
    """Sites whose outlines are variables."""

    def __init__(self, mesh: Mesh, camera: Camera, grid: Grid) -> None:
        self._lens, self._subdivision = camera.distortion, None
        self._constants = Constants(position_um=camera.position_um)
        self._is_moved = any(camera.position_um)
        outlines: Outlines = mesh.outlines
        if self._lens is not None:
            # The number of chords of each edge that the distortion requires.
            edges, layout = outlines.edges, mesh.layout().translate(*camera.position_um)
            pieces = UndistortedOutlines(layout, self._lens, min(grid.pitch_x_um, grid.pitch_y_um)).count_pieces()
            n_pieces = np.ones(edges.n_edges, np.int64)
            np.maximum.at(n_pieces, edges.edge, pieces)
            outlines, self._subdivision = outlines.subdivide(n_pieces)
        sensor = camera.sensor
        self.outlines_of = [outlines.select(np.flatnonzero(sensor.filter_of_site == c)) for c in sensor.filters_used]

    def points(self, points: Tensor, coefficients: Tensor, names: tuple[str, ...]) -> Tensor:
        """Return the points of the outlines in the plane of the maps, given those of the mesh."""
        if self._is_moved:
            points = points + self._constants.get("position_um", points)
        if self._lens is None or self._subdivision is None:
            return points
        return undistort(self._lens, self._subdivision(points), coefficients, names)


def _curve(wavelength_nm: Any, values: Any) -> Any:
    """Return a curve through values at wavelengths."""
    if np.size(wavelength_nm) == 1:
        return ConstantCurve(float(values[0]))
    return TableCurve(wavelength_nm=wavelength_nm.tolist(), value=values.tolist())


def capture(
    camera: Camera,
    scene: Scene,
    wrt: Iterable[str] = ("vertices",),
    *,
    exposure_s: Annotated[float, EXPOSURE],
    **options: Any,
) -> tuple[Tensor, Model]:
    """
    Compute the expected charges of a capture, with gradients to parts of the camera.

    Parameters
    ----------
    camera, scene, wrt, exposure_s, **options
        As for :class:`Model`.

    Returns
    -------
    expected_e : (n_site,) float64 tensor, e-
    model : Model
        With the variables as parameters.
    """
    model = Model(camera, scene, wrt, exposure_s=exposure_s, **options)
    return model(), model
