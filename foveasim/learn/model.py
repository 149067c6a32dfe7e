"""Camera as a PyTorch module, from scenes to expected charges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from foveasim.camera import Camera
from foveasim.camera._footprints import placed
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.integrate import UndistortedOutlines
from foveasim.learn._tensors import constant
from foveasim.learn.distortion import coefficient_names, coefficient_values, undistort, with_coefficients
from foveasim.learn.imaging import VARIABLES as LENS_VARIABLES
from foveasim.learn.imaging import Imaging, _check_variables
from foveasim.learn.integral import site_power
from foveasim.learn.mesh import Mesh
from foveasim.learn.readout import Readout
from foveasim.scene import Scene
from foveasim.sensor import ConstantCurve, FilterSet, TableCurve
from foveasim.units import photon_energy_j, w_from_w_m2_um2

__all__ = ["VARIABLES", "Model", "capture"]

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
        exposure_s: float,
        boundary: Literal["fixed", "sliding", "free"] = "fixed",
    ) -> None:
        super().__init__()
        self.wrt: tuple[str, ...] = _check_variables("wrt", wrt, VARIABLES)
        self._camera, self._scene = camera, camera.seen(scene)
        sensor = camera.sensor
        self.imaging: Imaging = Imaging(
            camera.optics, self._scene, [name for name in self.wrt if name in LENS_VARIABLES]
        )
        self.grid: Grid = camera.sensor_frame(self._scene).image(self.imaging.grid)
        self.register_buffer("_position_um", constant(camera.position_um))
        self.order = camera.order(self._scene)
        self._footprints = camera.footprints(scene)
        if self._footprints is not None and "vertices" in self.wrt:
            raise ParameterError(
                "wrt",
                "must not contain 'vertices' for a sensor with pixel optics, whose response and outlines are constants; remove "
                "'pixel_optics' from the sensor",
            )
        layout: Any = placed(camera.layout, self._footprints, (0.0, 0.0))
        self.mesh = Mesh(layout, boundary).requires_grad_("vertices" in self.wrt)
        self.readout: Readout = Readout(sensor)
        wave_nm = self._scene.wavelength_nm
        self.register_buffer("_photons_per_j", constant(1.0 / photon_energy_j(wave_nm)))
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
        self._parts = [
            (int(c), torch.from_numpy(np.flatnonzero(sensor.filter_of_site == c))) for c in sensor.filters_used
        ]
        self._outlines = self.mesh.outlines
        self._subdivision: Any = None
        if camera.distortion is not None:
            self._outlines, self._subdivision = self._outlines.subdivide(self._count_pieces())
        self._outlines_of = [self._outlines.select(sites.numpy()) for _, sites in self._parts]

    def __repr__(self) -> str:
        return f"Model({self._camera!r}, variables: {', '.join(self.wrt)})"

    def _count_pieces(self) -> Any:
        """Return the number of chords of each edge that the distortion requires."""
        edges = self._outlines.edges
        layout = self.mesh.layout().translate(*self._camera.position_um)
        lens = self._camera.distortion
        assert lens is not None
        pieces = UndistortedOutlines(layout, lens, min(self.grid.pitch_x_um, self.grid.pitch_y_um)).count_pieces()
        n_pieces = np.ones(edges.n_edges, np.int64)
        np.maximum.at(n_pieces, edges.edge, pieces)
        return n_pieces

    def points(self) -> Tensor:
        """Return the points of the outlines in the plane of the maps, (n_point, 2) tensor, µm."""
        points = self.mesh()
        if any(self._camera.position_um):
            points = points + self._position_um
        lens = self._camera.distortion
        if lens is None:
            return points
        return undistort(lens, self._subdivision(points), self.distortion, self.distortion_names)

    def photo_e_per_s(self, basis: Tensor | None = None) -> Tensor:
        """
        Compute the expected photoelectrons of each site per second.

        Parameters
        ----------
        basis : (..., n_basis, n_y, n_x) tensor, optional
            Basis images of scenes; by default those of the scene.

        Returns
        -------
        (..., n_site) float64 tensor, e-/s
        """
        used = [c for c, _ in self._parts]
        e_per_j = self.filters[used] * self.qe[used] * self._photons_per_j
        maps = self.imaging(e_per_j, basis)
        points = self.points()
        rates = torch.zeros(*maps.shape[:-3], self.mesh.n_sites, dtype=torch.float64)
        for k, (_, sites) in enumerate(self._parts):
            power = site_power(points, maps[..., k, :, :], self._outlines_of[k], self.grid, order=self.order)
            rates = rates.index_add(-1, sites, power)
        return self._collect(rates * float(w_from_w_m2_um2(1.0)))

    def _collect(self, rates: Tensor) -> Tensor:
        """Return the rates that the sites collect through pixel optics, (..., n_site)."""
        if self._footprints is None:
            return rates
        collected = rates * constant(self._footprints.factor)
        if self._footprints.mixing is None:
            return collected
        mixing = self._footprints.mixing.tocoo()
        rows, columns = (torch.from_numpy(each.astype(np.int64)) for each in (mixing.row, mixing.col))
        incident = rates / constant(self._footprints.area_ratio)
        return collected.index_add(-1, rows, incident[..., columns] * constant(mixing.data))

    def forward(self, basis: Tensor | None = None) -> Tensor:
        """
        Compute the expected charge of each site.

        Parameters
        ----------
        basis : (..., n_basis, n_y, n_x) tensor, optional
            As for :meth:`photo_e_per_s`.

        Returns
        -------
        (..., n_site) float64 tensor, e-
            ``model.readout`` draws charges and computes codes from them.
        """
        return self.readout.expected_e(self.photo_e_per_s(basis), self.exposure_s)

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
            curves = (self.filters * self.qe).detach().numpy()
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
            lens = with_coefficients(lens, self.distortion_names, self.distortion.detach().numpy())
        return Camera(
            optics=self.imaging.optics(),
            sensor=replace(sensor, **changes),
            distortion=lens,
            order=self.order,
            gaze_um=self._camera.gaze_um,
            axis=self._camera.axis,
        )


def _curve(wavelength_nm: Any, values: Any) -> Any:
    """Return a curve through values at wavelengths."""
    if np.size(wavelength_nm) == 1:
        return ConstantCurve(float(values[0]))
    return TableCurve(wavelength_nm=wavelength_nm.tolist(), value=values.tolist())


def capture(
    camera: Camera, scene: Scene, wrt: Iterable[str] = ("vertices",), *, exposure_s: float, **options: Any
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
