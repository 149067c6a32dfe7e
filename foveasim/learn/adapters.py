"""Sensor layers and layouts in the classes of other libraries: deepinv, torchvision, FOVI."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from foveasim._core.calls import Limits
from foveasim._core.extras import import_optional
from foveasim._core.validation import finite_array
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.layout._regions import disc
from foveasim.layout.diagrams.voronoi import voronoi_cells
from foveasim.layout.model import layout_of
from foveasim.learn.layer import SensorLayer

__all__ = ["from_fovi", "physics", "to_fovi", "transform"]

RADIUS = Limits(above=0.0)
#: Number of sides of the polygon that represents the circle around the samples of FOVI.
CHORDS = 720


def physics(layer: SensorLayer, *, generator: torch.Generator | None = None, **options: Any) -> Any:
    """
    Return a sensor as the physics of an inverse problem, for deepinv.

    Parameters
    ----------
    layer : SensorLayer
        With linear encoding.
    generator : torch.Generator, optional
        Random numbers of the noise, on the device of the pictures.
    **options
        Options of ``deepinv.physics.LinearPhysics``, such as ``max_iter`` and ``solver`` of the pseudoinverse.

    Returns
    -------
    deepinv.physics.LinearPhysics
        ``A`` maps pictures (batch, channel, row, column) to the expected charges of light (batch, n_site), in units of
        ``unit_e``, the largest charge for a white picture; ``A_adjoint`` is the product with the transposed matrix. The noise
        model draws charges with the temporal noise of the sensor, and subtracts the expected dark signal.

    Raises
    ------
    ParameterError
        When the encoding is not linear, or deepinv is not installed.

    Examples
    --------
    ::

        problem = fs.learn.physics(layer)
        readings = problem(pictures)
        picture = problem.A_dagger(readings)  # least squares
    """
    if layer.encoding != "linear":
        raise ParameterError(
            "layer", f"must have linear encoding, got '{layer.encoding}'", hint="decode pictures first"
        )
    return _physics(layer, generator, options)


def _physics(layer: SensorLayer, generator: torch.Generator | None, options: dict[str, Any]) -> Any:
    return _physics_class()(layer, generator, **options)


@cache
def _physics_class() -> Any:
    """Return the class of :func:`physics`, which is defined on first use."""
    import_optional("physics", "deepinv")
    from deepinv.physics import LinearPhysics, NoiseModel

    class SensorNoise(NoiseModel):  # type: ignore[misc]
        """Temporal noise of charges in units of the physics."""

        def __init__(self, problem: Any, generator: torch.Generator | None) -> None:
            super().__init__(rng=generator)
            self._draw = problem.draw

        def forward(self, input: Tensor, seed: int | None = None, **_: Any) -> Tensor:  # noqa: A002 - of deepinv
            self.rng_manual_seed(seed)
            found: Tensor = self._draw(input, self.rng)
            return found

    class SensorPhysics(LinearPhysics):  # type: ignore[misc]
        """Sensor as the physics of an inverse problem."""

        def __init__(self, layer: SensorLayer, generator: torch.Generator | None, **options: Any) -> None:
            super().__init__(img_size=(layer.channels, *layer.picture_shape), **options)
            self.layer = layer
            white = torch.ones(1, layer.channels, *layer.picture_shape, device=layer.model.exposure_s.device)
            with torch.no_grad():
                self._dark = layer.light_e(torch.zeros_like(white), with_dark=True)[0]
                self.unit_e: float = float(layer.light_e(white).max())
            self.noise_model = SensorNoise(self, generator)
            self._arguments = layer, generator, options

        def __reduce__(self) -> tuple[Any, ...]:
            # Pickle cannot import a class that is defined in a function.
            return _physics, self._arguments

        def A(self, x: Tensor, **_: Any) -> Tensor:  # noqa: N802 - of deepinv
            return self.layer.light_e(x) / self.unit_e

        def A_adjoint(self, y: Tensor, **_: Any) -> Tensor:  # noqa: N802 - of deepinv
            is_variable = y.requires_grad and torch.is_grad_enabled()
            with torch.enable_grad():
                x = y.new_zeros(y.shape[0], self.layer.channels, *self.layer.picture_shape, requires_grad=True)
                (found,) = torch.autograd.grad(self.A(x), x, y, create_graph=is_variable)
            return found if is_variable else found.detach()

        def draw(self, y: Tensor, generator: torch.Generator | None) -> Tensor:
            """Return readings with noise, without the expected dark signal."""
            dark_e = self._dark.to(y)
            expected_e = (y * self.unit_e + dark_e).clamp_min(0.0)
            return (self.layer.readout.draw(expected_e, generator) - dark_e) / self.unit_e

    return SensorPhysics


def transform(layer: SensorLayer) -> Any:
    """
    Return a sensor as a transform of torchvision, for the images of data sets.

    Parameters
    ----------
    layer : SensorLayer

    Returns
    -------
    torchvision.transforms.v2.Transform
        Replaces images (tensors, ``tv_tensors.Image``, images of Pillow) by readings; labels, boxes and masks pass. Integers
        are divided by the maximum of their dtype: use the encoding ``"srgb"`` for photographs.

    Raises
    ------
    ParameterError
        When torchvision is not installed.

    Examples
    --------
    ::

        chain = v2.Compose([v2.Resize((96, 96)), fs.learn.transform(layer)])
        readings, label = chain(photograph, 3)
    """
    return _transform_class()(layer)


@cache
def _transform_class() -> Any:
    """Return the class of :func:`transform`, which is defined on first use."""
    import_optional("transform", "torchvision")
    from PIL.Image import Image
    from torchvision import tv_tensors
    from torchvision.transforms import v2

    class SensorTransform(v2.Transform):  # type: ignore[misc]
        """Readings of a sensor in place of images."""

        _transformed_types = tv_tensors.Image, Image, lambda value: type(value) is Tensor

        def __init__(self, layer: SensorLayer) -> None:
            super().__init__()
            self.layer = layer

        def __reduce__(self) -> tuple[Any, ...]:
            return transform, (self.layer,)

        def transform(self, inpt: Any, params: dict[str, Any]) -> Tensor:
            del params
            picture = v2.functional.to_dtype(
                v2.functional.to_image(inpt).as_subclass(Tensor), torch.float32, scale=True
            )
            found: Tensor = self.layer(picture)
            return found

    return SensorTransform


def from_fovi(samples: Any, *, radius_um: Annotated[float, RADIUS]) -> Layout:
    """
    Return the Voronoi cells of the sampling positions of the package ``fovi``.

    Parameters
    ----------
    samples : fovi.sensing.coords.SamplingCoords, or (n_site, 2) tensor or array
        Normalised positions (x, y), with y upwards: 1 is the radius of the field.
    radius_um : float, µm
        Radius of the field.

    Returns
    -------
    Layout
        Cells in the order of the samples, with the positions of the samples as columns ``sample_x_um`` and ``sample_y_um``.
        They fill a circle that extends beyond the outermost sample by half the distance to its nearest neighbour.

    Raises
    ------
    ParameterError
        When the positions do not have the shape (n_site, 2), are not finite, or coincide.

    Examples
    --------
    ::

        coords = fovi.sensing.coords.SamplingCoords(fov=16.0, cmf_a=0.5, res=32)
        layout = fs.learn.from_fovi(coords, radius_um=500.0)
    """
    values = getattr(samples, "cartesian", samples)
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    centres_um = radius_um * finite_array("samples", np.asarray(array, np.float64), ndim=2)
    if centres_um.shape[1:] != (2,) or centres_um.shape[0] < 2:
        raise ParameterError("samples", f"must have the shape (n_site, 2), got {centres_um.shape}")
    if np.unique(centres_um, axis=0).shape != centres_um.shape:
        raise ParameterError("samples", "must be at different positions")
    distance_um = np.hypot(*centres_um.T)
    outer = int(np.argmax(distance_um))
    others = np.delete(np.hypot(*(centres_um - centres_um[outer]).T), outer)
    end_um = float(distance_um[outer] + 0.5 * others.min())
    xy_um, offsets = voronoi_cells(centres_um, disc(end_um, CHORDS))
    columns = {"sample_x_um": centres_um[:, 0].copy(), "sample_y_um": centres_um[:, 1].copy()}
    return layout_of(xy_um, offsets, None, columns, {"radius_um": end_um})


def to_fovi(layout: Layout, *, radius_um: Annotated[float, RADIUS]) -> Tensor:
    """
    Return photosites as sampling positions of the package ``fovi``.

    Parameters
    ----------
    layout : Layout
    radius_um : float, µm
        Radius of the field, which becomes 1.

    Returns
    -------
    (n_site, 2) float32 tensor
        Centroids (x, y), or the samples of a layout of :func:`from_fovi`.

    Examples
    --------
    >>> import foveasim as fs
    >>> to_fovi(fs.layout.grid(n_x=2, n_y=1, pitch_um=10.0), radius_um=10.0).tolist()
    [[-0.5, 0.0], [0.5, 0.0]]
    """
    names = "sample_x_um", "sample_y_um"
    has_samples = all(name in layout.columns for name in names)
    centres_um = np.stack([layout.columns[name] for name in names], axis=1) if has_samples else layout.centroid_um
    return torch.tensor(centres_um / radius_um, dtype=torch.float32)
