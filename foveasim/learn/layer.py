"""Sensor as a layer of a network: from pictures to readings, on any device."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from foveasim.camera import Camera
from foveasim.errors import ParameterError
from foveasim.learn._tensors import checked_gazes, in_parts
from foveasim.learn.model import Model
from foveasim.learn.readout import Readout
from foveasim.scene import Scene
from foveasim.sensor.limits import EXPOSURE

__all__ = ["SensorLayer"]

Output = Literal["code", "charge", "expected"]
#: Luminance of white, cd/m², and distance, m, of pictures without a scene.
LUMINANCE_CD_M2, DISTANCE_M = 100.0, 1.0
#: Values above this one are codes of 8 or 16 bits instead of relative radiances.
LARGEST_VALUE = 16.0


class SensorLayer(nn.Module):
    """
    Camera as a layer of a network.

    Pictures pass the optics, are integrated over the photosites, become charges with noise, and then codes. All operations are
    those of PyTorch on the device of the pictures, so that gradients pass to the pictures, and to the variables of the camera;
    on the CPU, kernels replace some of them where no gradients are needed.

    Parameters
    ----------
    camera : Camera
        Initial values.
    scene : Scene, optional
        Geometry and spectrum of the pictures: a basis image is a channel.
    wrt : iterable of str
        Variables of the camera, as for :class:`Model`; by default none.
    scene_shape : (n_channel, n_y, n_x) or (n_y, n_x), optional
        Shape of the pictures, instead of a scene: with 3 channels (default) linear RGB, with 1 grey. White has 100 cd/m² at a
        distance of 1 m, and the picture covers the layout.
    exposure_s : float, optional, s
        By default that of the automatic exposure for a white picture.
    encoding : {"linear", "srgb", "sqrt"}
        Encoding of the values, as for :meth:`Scene.from_picture`.
    output : {"code", "charge", "expected"}
        Codes, DN; charges with noise, e-; expected charges, e-.
    noise : bool
        Whether codes and charges contain temporal noise. Codes without noise are those of the expected charges.
    boundary : {"fixed", "sliding", "free"}
        As for :class:`Mesh`.

    Attributes
    ----------
    model : Model
        With the variables as parameters.
    channels : int
        Number of channels of the pictures.
    n_sites : int
    max_code : int
        Highest code.

    Raises
    ------
    ParameterError
        Unless exactly one of ``scene`` and ``scene_shape`` is given; as for :class:`Model`.

    Notes
    -----
    The precision is that of the pictures: float32 or float64. Under autocast, and for pictures of 16 bits, the layer computes
    in float32, as sums over cells and Fourier transforms lose too much in bfloat16.

    A gaze per picture shifts the spectrum of its image, which is exact for the continuous image where the cells of the map
    resolve it, as those of automatic oversampling do for square source pixels, and for pixels narrower than λN. It then
    differs from :meth:`Camera.capture` with the same gaze by the accuracy of the integration. With coarser cells, images
    shifted by parts of a cell ring at edges: a :class:`foveasim.errors.SamplingWarning` states the error. Beyond the picture,
    the image continues as its padding.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> sensor = fs.Sensor(
    ...     fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=8.0),
    ...     bits=10,
    ...     read_noise_e=2.0,
    ... )
    >>> layer = SensorLayer(fs.Camera(optics=lens, sensor=sensor), scene_shape=(3, 64, 64))
    >>> layer(torch.rand(5, 3, 64, 64)).shape
    torch.Size([5, 400])
    """

    def __init__(
        self,
        camera: Camera,
        scene: Scene | None = None,
        wrt: Iterable[str] = (),
        *,
        scene_shape: tuple[int, ...] | None = None,
        exposure_s: Annotated[float | None, EXPOSURE] = None,
        encoding: Literal["linear", "srgb", "sqrt"] = "linear",
        output: Output = "code",
        noise: bool = True,
        boundary: Literal["fixed", "sliding", "free"] = "fixed",
    ) -> None:
        super().__init__()
        if (scene is None) == (scene_shape is None):
            raise ParameterError("scene", "must be given, or 'scene_shape', but not both")
        template = _template(scene_shape) if scene is None else scene
        white = replace(template, basis=np.ones(template.basis.shape, np.float32))
        if exposure_s is None:
            exposure_s = camera.sensor.exposure_for(camera.photoelectrons_per_s(white))
        self.model = Model(camera, white, wrt, exposure_s=exposure_s, boundary=boundary)
        self.channels: int
        self.channels, *shape = white.basis.shape
        self._shape: tuple[int, ...] = tuple(shape)
        self.encoding, self.output, self.noise = encoding, output, noise

    def __repr__(self) -> str:
        shape = " x ".join(map(str, (self.channels, *self._shape)))
        return f"SensorLayer({shape} values to {self.n_sites} sites, output '{self.output}')"

    @property
    def n_sites(self) -> int:
        """Number of photosites."""
        return self.model.n_sites

    @property
    def picture_shape(self) -> tuple[int, ...]:
        """Rows and columns of the pictures."""
        return self._shape

    @property
    def max_code(self) -> int:
        """Highest code."""
        return self.readout.sensor.adc.n_codes - 1

    @property
    def readout(self) -> Readout:
        """Electronics."""
        return self.model.readout

    def camera(self) -> Camera:
        """Return the camera with the current values of its variables: :meth:`Model.camera`."""
        return self.model.camera()

    def _check(self, pictures: Tensor) -> None:
        """Raise unless pictures have the type, shape and device of this layer."""
        if not pictures.is_floating_point():
            raise ParameterError(
                "pictures",
                f"must be floating-point numbers from 0 to 1, got {pictures.dtype}",
                hint="for 8 bits use pictures / 255, and encoding='srgb' for photographs",
            )
        expected = (self.channels, *self._shape)
        if pictures.ndim < 3 or tuple(pictures.shape[-3:]) != expected:
            shape, hint = tuple(pictures.shape), ""
            if pictures.ndim >= 3 and shape[-3:] == (*self._shape, self.channels):
                hint = "channels come before rows and columns: use .movedim(-1, -3)"
            elif pictures.ndim >= 3 and shape[-2:] == self._shape:
                hint = f"the scene has {self.channels} channels"
            wanted = ", ".join(map(str, expected))
            raise ParameterError("pictures", f"must have the shape (..., {wanted}), got {shape}", hint=hint)
        parameter = self.model.exposure_s
        if any(each.device != pictures.device for each in self.model.parameters()):
            raise ParameterError(
                "pictures",
                f"must be on the device of the layer, {parameter.device}, got {pictures.device}",
                hint="use layer.to(device)",
            )

    def _basis(self, pictures: Tensor) -> Tensor:
        """Return basis images, top row first, after validation of the values."""
        if pictures.dtype in (torch.float16, torch.bfloat16):
            pictures = pictures.float()
        if pictures.device.type != "meta" and not torch.compiler.is_compiling() and pictures.numel():
            lowest, highest = (float(each) for each in torch.aminmax(pictures.detach()))
            if not (math.isfinite(lowest) and math.isfinite(highest)):
                raise ParameterError("pictures", "must be finite", hint="replace NaN and infinite values")
            if highest > LARGEST_VALUE:
                raise ParameterError(
                    "pictures", "must be relative radiances, 1 for white", highest, hint="divide those of 8 bits by 255"
                )
            if lowest < 0.0:
                raise ParameterError("pictures", "must be >= 0", lowest, hint="undo the normalisation of the data set")
        if self.encoding == "srgb":
            pictures = torch.where(
                pictures <= 0.04045, pictures / 12.92, ((pictures.clamp_min(0.04) + 0.055) / 1.055) ** 2.4
            )
        elif self.encoding == "sqrt":
            pictures = pictures * pictures
        return pictures

    def photo_e_per_s(self, pictures: Tensor, gaze_um: Tensor | None = None) -> Tensor:
        """
        Compute the expected photoelectrons of each site per second.

        A linear function of pictures with linear encoding.

        Parameters
        ----------
        pictures, gaze_um
            As for :meth:`forward`.

        Returns
        -------
        (..., n_site) or (..., n_gaze, n_site) tensor, e-/s
        """
        return self._finished(pictures, gaze_um, lambda rates: rates)

    def _finished(self, pictures: Tensor, gaze_um: Tensor | None, finish: Callable[[Tensor], Tensor]) -> Tensor:
        """Return a function of the photoelectrons per second, for each part of a batch."""
        self._check(pictures)
        flat, shape, gaze = pictures.reshape(-1, *pictures.shape[-3:]), pictures.shape[:-3], None
        if gaze_um is not None:
            gaze = checked_gazes(gaze_um, shape)
            shape = gaze_um.shape[:-1]
        with _full_precision(pictures):
            # Parts are checked, decoded and read while they are in the cache.
            found = in_parts(
                lambda part, gaze: self.model.photo_e_per_s(self._basis(part), gaze, origin="upper"),
                self.model.parts(flat, gaze), flat, gaze, finish=finish,
            )  # fmt: skip
            return found.reshape(*shape, self.n_sites)

    def light_e(self, pictures: Tensor, *, with_dark: bool = False) -> Tensor:
        """
        Compute the expected charges of light, a linear function also of negative values.

        Parameters
        ----------
        pictures : (..., n_channel, n_y, n_x) tensor
            Linear values, without a check of their range.
        with_dark : bool
            Whether to add the expected dark signal.

        Returns
        -------
        (..., n_site) tensor, e-
        """
        self._check(pictures)
        with _full_precision(pictures):
            rates = self.model.photo_e_per_s(pictures, origin="upper")
            exposure_s = self.model.exposure_s.to(rates.dtype)
            total_e = self.readout.expected_e(rates, exposure_s)
            return total_e if with_dark else total_e - self.readout.expected_e(torch.zeros_like(rates), exposure_s)

    def expected_e(self, pictures: Tensor, gaze_um: Tensor | None = None) -> Tensor:
        """
        Compute the expected charges, (..., n_site) or (..., n_gaze, n_site) tensor, e-.

        Parameters
        ----------
        pictures, gaze_um
            As for :meth:`forward`.
        """
        return self._finished(pictures, gaze_um, self._expected_e)

    def _expected_e(self, rates: Tensor) -> Tensor:
        return self.readout.expected_e(rates.clamp_min(0.0), self.model.exposure_s.to(rates.dtype))

    def forward(
        self, pictures: Tensor, gaze_um: Tensor | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """
        Compute the readings of pictures.

        Parameters
        ----------
        pictures : (..., n_channel, n_y, n_x) tensor
            Top row first, as in torchvision; values from 0, white is 1.
        gaze_um : (..., 2) or (..., n_gaze, 2) tensor, optional, µm
            Gaze for each picture, or a path of gazes, in addition to that of the camera.
        generator : torch.Generator, optional
            Random numbers of the noise, on the device of the pictures; those of torch by default.

        Returns
        -------
        (..., n_site) or (..., n_gaze, n_site) tensor
            Codes, DN, or charges, e-: see ``output``.
        """

        def read(rates: Tensor) -> Tensor:
            charge_e = self._expected_e(rates)
            if self.noise:
                charge_e = self.readout.draw(charge_e, generator)
            return charge_e if self.output == "charge" else self.readout.code(charge_e)

        if self.output == "expected":
            return self._finished(pictures, gaze_um, self._expected_e)
        with _unchanged_on_error(generator if self.noise else None):
            return self._finished(pictures, gaze_um, read)


@contextmanager
def _unchanged_on_error(generator: torch.Generator | None) -> Iterator[None]:
    """Restore the state of a generator after an error, before which parts may have been drawn."""
    state = None if generator is None or torch.compiler.is_compiling() else generator.get_state()
    try:
        yield
    except BaseException:
        if generator is not None and state is not None:
            generator.set_state(state)
        raise


def _template(shape: Any) -> Scene:
    """Return a scene for pictures of a shape."""
    if not isinstance(shape, tuple | list) or len(shape) not in (2, 3) or any(n < 1 or n != int(n) for n in shape):
        raise ParameterError("scene_shape", "must be (n_y, n_x), or (n_channel, n_y, n_x)", shape)
    channels, n_y, n_x = (3, *shape) if len(shape) == 2 else shape
    if channels not in (1, 3):
        raise ParameterError(
            "scene_shape", f"must have 1 or 3 channels, got {channels}", hint="pass a Scene for other spectra"
        )
    white = np.ones((n_y, n_x, channels) if channels == 3 else (n_y, n_x), np.float32)
    return Scene.from_picture(white, distance_m=DISTANCE_M, luminance_cd_m2=LUMINANCE_CD_M2, encoding="linear")


def _full_precision(like: object) -> torch.autocast:
    """Return a context without autocast."""
    kind = like.device.type if isinstance(like, Tensor) and like.device.type != "meta" else "cpu"
    return torch.autocast(kind, enabled=False)
