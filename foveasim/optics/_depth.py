"""
Power maps of scenes with depth: layers, of which near ones cover far ones.

The pixels of a picture with depth are directions. Pixels with almost equal reciprocal distances form a layer l, with cover α_l
and radiance S_l. Each layer is imaged through the same pupil with its own defocus, h_l. From the nearest layer to the farthest,
each fills what nearer ones have left of the pupil: its share is ``w_l = min(h_l ∗ α_l, 1 - Σ_{m<l} w_m)``, and

    E = Σ_l w_l (h_l ∗ α_l S_l) / (h_l ∗ α_l)  /  Σ_l w_l

Dividing by the sum of the shares, that of the same scene with equal radiances, keeps equal radiances flat: H. Ikoma et al.,
Depth from defocus with learned optics for imaging and occlusion-aware depth estimation, ICCP (2021). Their share is the product
``(h_l ∗ α_l) Π_{m<l} (1 - h_m ∗ α_m)``, as if layers covered independent parts of the pupil. It is the same for two layers of
which the far one is continued behind the near one. On inclined surfaces, whose adjacent layers fill the pupil side by side, the
sum of the shares is that of the covers, which the product underestimates.

A picture with depth does not contain what near objects hide. Where the depth steps, the far surface is continued behind the
near one, with the radiance of the nearest visible pixel at its rim.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Images, Ints
from foveasim._io.mapped_files import in_memory
from foveasim._projections import ImageProjection
from foveasim.optics._imaging import MapRows

if TYPE_CHECKING:
    from foveasim.fields import SceneLike

#: Step of the blur radius between neighbouring pixels, in cells, above which a surface ends behind another one.
STEP_CELLS = 1.5
#: Smallest sum of shares: a division by less would amplify rounding errors.
MIN_SHARE = 1e-3
#: Rows of maps that are composed together.
ROWS_TOGETHER = 64
#: Points of the pupil of the reference: rings of equal area, and points on each.
REFERENCE_RINGS, REFERENCE_POINTS = 12, 24


@dataclass(frozen=True)
class Layer:
    """Pixels of a layer, ``number`` from near to far, which is imaged as if at a distance."""

    number: int
    distance_m: float


@dataclass(frozen=True, eq=False)
class Layers:
    """
    Layers of a picture with depth, from near to far.

    ``layers``: those with pixels. ``visible`` (n_y, n_x): number of the layer of each pixel. ``hidden`` (n_y, n_x): number of
    the layer behind it, -1 for none. ``rim`` (n_y, n_x): flat index of the pixel whose radiance continues there.
    """

    layers: Sequence[Layer]
    visible: Ints
    hidden: Ints
    rim: Ints

    @classmethod
    def of(cls, depth_m: Floats, blur_cells_m: float, focus_m: float, max_layers: int | None) -> Layers:
        """
        Return the layers of distances (n_y, n_x).

        ``blur_cells_m``: blur radius in cells per difference of reciprocal distances in 1/m. Layers are steps of one cell
        around the focus, or wider ones if there would be more than ``max_layers``.
        """
        radius = blur_cells_m * (1.0 / depth_m - 1.0 / focus_m)  # signed: near positive
        nearest, farthest = float(radius.max()), float(radius.min())
        step = 1.0
        if max_layers is not None and nearest - farthest > max_layers - 1:
            step = (nearest - farthest) / max(max_layers - 1, 0.5)
        number = np.rint(nearest / step) - np.rint(radius / step)
        if max_layers is not None:
            number = np.minimum(number, max_layers - 1)
        visible = number.astype(np.int32)
        hidden, rim = _continued(radius, visible)
        used = np.flatnonzero(np.bincount(visible.ravel()))
        layers = [Layer(int(k), _distance_m(depth_m[visible == k], focus_m)) for k in used]
        return cls(layers, visible, hidden, rim)

    def cover(self, layer: Layer, images: Images | None, real: Any) -> NDArray[Any]:
        """Return the pixels of a layer, (n_basis, n_y, n_x), or its cover (1, n_y, n_x)."""
        is_visible, behind = self.visible == layer.number, np.flatnonzero(self.hidden == layer.number)
        if images is None:
            found = is_visible[np.newaxis].astype(real)
            found.reshape(1, -1)[:, behind] = 1.0
            return found
        found = np.zeros(images.shape, images.dtype)
        for image, out in zip(images, found, strict=True):
            pixels = in_memory(image)
            np.copyto(out, pixels, where=is_visible)
            out.ravel()[behind] = pixels.ravel()[self.rim.ravel()[behind]]
        return found

    @cached_property
    def extremes_m(self) -> tuple[float, ...]:
        """Distances of the nearest and the farthest layer."""
        return tuple(sorted({self.layers[0].distance_m, self.layers[-1].distance_m}))


def _distance_m(depth_m: Floats, focus_m: float) -> float:
    """Return the distance of a layer: its own, the focus within it, or the middle of its blur."""
    nearest_m, farthest_m = float(depth_m.min()), float(depth_m.max())
    if nearest_m == farthest_m:
        return nearest_m
    if nearest_m <= focus_m <= farthest_m:
        return focus_m
    return 2.0 / (1.0 / nearest_m + 1.0 / farthest_m)


def _continued(radius: Floats, visible: Ints) -> tuple[Ints, Ints]:
    """Return the layer behind each pixel, and the pixel at whose rim its surface ends."""
    is_rim = np.zeros(radius.shape, bool)
    for axis in (0, 1):
        ahead = np.diff(radius, axis=axis) > STEP_CELLS  # the next pixel is nearer
        behind = np.diff(radius, axis=axis) < -STEP_CELLS
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        is_rim[tuple(low)] |= ahead
        is_rim[tuple(high)] |= behind
    if not is_rim.any():
        return np.full(radius.shape, -1, np.int32), np.zeros(radius.shape, np.int32)
    from scipy.ndimage import distance_transform_edt

    at_y, at_x = distance_transform_edt(~is_rim, return_distances=False, return_indices=True)
    rim = at_y * radius.shape[1] + at_x
    is_behind: Bools = radius - radius.ravel()[rim] > STEP_CELLS
    of_rim = visible.ravel()[rim]
    return np.where(is_behind & (of_rim > visible), of_rim, np.int32(-1)), rim


@dataclass(frozen=True, eq=False)
class LayerLight:
    """Pixels of one layer, as a scene at the place of the whole picture."""

    basis: Images
    spectrum_w_m2_sr_nm: Floats
    wavelength_nm: Floats
    band_width_nm: Floats
    pitch_um: float | None
    centre_um: tuple[float, float]
    distance_m: float
    projection: ImageProjection

    @classmethod
    def of(cls, scene: SceneLike, images: Images, spectrum_w_m2_sr_nm: Floats) -> LayerLight:
        """Return images of a layer with the geometry and the bands of a scene."""
        return cls(
            images,
            spectrum_w_m2_sr_nm,
            scene.wavelength_nm,
            scene.band_width_nm,
            scene.pitch_um,
            scene.centre_um,
            scene.distance_m,
            scene.projection,
        )


#: Function of (light, layer, is_cover) that returns the rows of the maps of all outputs, without relative illumination.
MapsOfLayer = Callable[[LayerLight, Layer, bool], Iterator[MapRows]]


def mean_spectrum(scene: SceneLike) -> Floats:
    """Return the mean spectral radiance of a scene, (n_wavelength,); 1 if it is dark."""
    means = np.array([in_memory(image).mean(dtype=np.float64) for image in scene.basis])
    found = np.asarray(np.einsum("b,bk->k", means, scene.spectrum_w_m2_sr_nm))
    return found if found.any() else np.ones(found.size)


def composed_maps(
    scene: SceneLike, layers: Layers, maps_of: MapsOfLayer, cover: Floats, shape: tuple[int, int], real: Any
) -> NDArray[Any]:
    """
    Return the maps (n_output, n_y, n_x) of layers that cover each other.

    Relative illumination is not applied. The spectra of one layer are in memory at a time. ``cover`` (n_output,): outputs for
    the mean spectrum of the scene.
    """
    total, left = np.zeros((cover.size, *shape), real), np.ones((cover.size, *shape), real)
    white = mean_spectrum(scene)[np.newaxis]
    for layer in layers.layers:
        covers = maps_of(LayerLight.of(scene, layers.cover(layer, None, real), white), layer, True)
        pixels = layers.cover(layer, scene.basis, real)
        lights = maps_of(LayerLight.of(scene, pixels, scene.spectrum_w_m2_sr_nm), layer, False)
        for c, (rows_of_cover, rows_of_light) in enumerate(zip(covers, lights, strict=True)):
            if cover[c] == 0.0:
                continue
            for first in range(0, shape[0], ROWS_TOGETHER):
                last = min(first + ROWS_TOGETHER, shape[0])
                share = rows_of_cover(first, last) * real(1.0 / cover[c])
                part, room = rows_of_light(first, last), left[c, first:last]
                # A cover within the room keeps its light as it is, rounding errors included, which conserves energy.
                filled = np.minimum(share, room)
                part *= np.divide(filled, share, out=np.ones_like(share), where=share > room)
                total[c, first:last] += part
                room -= filled
    total /= np.maximum(1.0 - left, real(MIN_SHARE))
    return total


def fine_pixels(layers: Layers, n_fine: int) -> Layers:
    """Return the layers of pixels that are divided into n x n cells."""
    if n_fine == 1:
        return layers
    visible, hidden = (np.repeat(np.repeat(each, n_fine, 0), n_fine, 1) for each in (layers.visible, layers.hidden))
    row, column = (n_fine * part for part in np.divmod(layers.rim, layers.rim.shape[1]))
    rim = row * visible.shape[1] + column
    return Layers(layers.layers, visible, hidden, np.repeat(np.repeat(rim, n_fine, 0), n_fine, 1))


def reference_map(
    layers: Layers,
    images: NDArray[Any],
    shifts_cells: Callable[[Layer, Floats], Floats],
    transmittance: Callable[[Floats], Floats],
    padding: str,
) -> NDArray[Any]:
    """
    Return an image (n_y, n_x) as the mean over points of the pupil.

    At each, near layers hide far ones. ``images``: pixels (1, n_y, n_x). ``shifts_cells``: function of a layer and points
    (n, 2) of the pupil that returns the displacements (n, 2) of its image along x and y. ``transmittance``: power at the
    points.
    """
    from scipy.ndimage import shift

    modes = {"reflect": "mirror", "edge": "nearest", "zero": "constant", "periodic": "grid-wrap"}
    points = _pupil_points()
    weight = transmittance(points)
    parts = []
    for layer in layers.layers:
        cover = layers.cover(layer, None, np.float64)[0]
        parts.append((cover, layers.cover(layer, images, np.float64)[0], shifts_cells(layer, points)))
    total, total_weight = np.zeros(images.shape[1:]), np.zeros(images.shape[1:])
    for k in np.flatnonzero(weight):
        light, left = np.zeros(images.shape[1:]), np.ones(images.shape[1:])
        for cover, pixels, shifts in parts:
            moved = partial(shift, shift=shifts[k, ::-1], order=1)
            of_cover = moved(cover, mode=modes["edge" if padding == "zero" else padding])
            light += left * moved(pixels, mode=modes[padding])
            left *= 1.0 - np.clip(of_cover, 0.0, 1.0)
        is_seen = left < 1.0 - MIN_SHARE
        total[is_seen] += weight[k] * light[is_seen] / (1.0 - left[is_seen])
        total_weight[is_seen] += weight[k]
    return np.asarray(total / np.maximum(total_weight, MIN_SHARE * weight.sum()))


def _pupil_points() -> Floats:
    """Return points (n, 2) of the unit disc that represent equal areas."""
    radius = np.sqrt((np.arange(REFERENCE_RINGS) + 0.5) / REFERENCE_RINGS)[:, np.newaxis]
    golden = 0.5 * (math.sqrt(5.0) - 1.0)  # of turns between the first points of rings
    turns = (np.arange(REFERENCE_POINTS) + golden * np.arange(REFERENCE_RINGS)[:, np.newaxis]) / REFERENCE_POINTS
    angle = 2.0 * np.pi * turns
    return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=-1).reshape(-1, 2)
