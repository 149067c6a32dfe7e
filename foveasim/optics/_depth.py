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

from foveasim._core.threads import parallel_map
from foveasim._core.validation import Bools, Floats, Images, Ints
from foveasim._io.mapped_files import in_memory
from foveasim._projections import ImageProjection
from foveasim.optics._imaging import MapRows

if TYPE_CHECKING:
    from foveasim.fields import SceneLike

#: Step of the blur radius between neighbouring pixels, in cells, above which a surface ends behind another one; and the smaller
#: step, which is an edge if it is at least so many times that of both adjacent pairs of pixels: else the surface is steep, or
#: its distances are noisy.
STEP_CELLS, MIN_STEP_CELLS, STEP_RATIO = 1.5, 0.5, 4.0
#: Cells beyond the blur that a surface is continued.
REACH_CELLS = 2.0
#: Smallest sum of shares: a division by less would amplify rounding errors.
MIN_SHARE = 1e-3
#: Rows of maps that are composed together.
ROWS_TOGETHER = 64
#: Points of the pupil of the reference: rings of equal area, and points on each.
REFERENCE_RINGS, REFERENCE_POINTS = 12, 24


@dataclass(frozen=True, eq=False)
class Layer:
    """
    Pixels of a layer, which is imaged as if at a distance.

    ``visible`` (n,): flat indices of its pixels. ``hidden`` (m,): flat indices of pixels of nearer layers, behind which it
    continues. ``rim`` (m,): flat indices of the pixels whose radiance it has there.
    """

    distance_m: float
    visible: Ints
    hidden: Ints
    rim: Ints

    def rows(self, n_x: int) -> tuple[int, int]:
        """
        Return the range of rows that have pixels of the layer.

        ``n_x``: number of columns of the picture.
        """
        ends = [pixels[[0, -1]] // n_x for pixels in (self.visible, self.hidden) if pixels.size]
        return min(int(first) for first, _ in ends), max(int(last) for _, last in ends) + 1

    def write(self, images: Images | None, out: NDArray[Any]) -> None:
        """Write the pixels of the layer to images (n_basis, n_y, n_x) of 0, or its cover, 1."""
        from foveasim.optics._kernels import copy_pixels

        if images is None:
            self.fill(out, 1.0)
            return
        for image, cells in zip(images, out, strict=True):
            pixels = np.ascontiguousarray(in_memory(image)).reshape(-1)
            copy_pixels(pixels, self.visible, self.visible, cells.reshape(-1))
            copy_pixels(pixels, self.rim, self.hidden, cells.reshape(-1))

    def fill(self, out: NDArray[Any], value: float) -> None:
        """Write a value to the pixels of the layer."""
        from foveasim.optics._kernels import fill_pixels

        for cells in out:
            for pixels in (self.visible, self.hidden):
                fill_pixels(out.dtype.type(value), pixels, cells.reshape(-1))


@dataclass(frozen=True, eq=False)
class Layers:
    """Layers of a picture with depth, from near to far. ``shape``: (n_y, n_x) of the picture."""

    layers: Sequence[Layer]
    shape: tuple[int, int]

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
        number = number.astype(np.int32)
        behind, rim = _continued(radius, number)
        is_hidden = behind.ravel() >= 0
        hidden = np.flatnonzero(is_hidden)
        visible_of, hidden_of = _sorted(number.ravel()), _sorted(behind.ravel()[hidden])
        layers = []
        for k, visible in visible_of.items():
            continued = hidden[hidden_of.get(k, np.empty(0, np.intp))]
            distance_m = _distance_m(depth_m.ravel()[visible], focus_m)
            layers.append(Layer(distance_m, visible, continued, rim.ravel()[continued].astype(np.int64)))
        return cls(layers, (depth_m.shape[0], depth_m.shape[1]))


def _sorted(number: Ints) -> dict[int, Ints]:
    """Return the indices of each number that occurs, in ascending order."""
    order = np.argsort(number, kind="stable")
    found, first = np.unique(number[order], return_index=True)
    return dict(zip(found.tolist(), np.split(order, first[1:]), strict=True)) if number.size else {}


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
    for along, rims in ((radius, is_rim), (radius.T, is_rim.T)):
        step = np.diff(along, axis=1)  # > 0: the next pixel is nearer
        size = np.pad(np.abs(step), ((0, 0), (1, 1)))
        slope = np.maximum(size[:, :-2], size[:, 2:])
        is_edge = size[:, 1:-1] > np.minimum(STEP_CELLS, np.maximum(MIN_STEP_CELLS, STEP_RATIO * slope))
        rims[:, :-1] |= is_edge & (step > 0.0)
        rims[:, 1:] |= is_edge & (step < 0.0)
    if not is_rim.any():
        return np.full(radius.shape, -1, np.int32), np.zeros(radius.shape, np.int32)
    from scipy.ndimage import distance_transform_edt

    distance, (at_y, at_x) = distance_transform_edt(~is_rim, return_indices=True)
    rim = at_y * radius.shape[1] + at_x
    of_rim_cells = radius.ravel()[rim]
    # Light of the hidden surface arrives within the blur of both.
    is_near = distance < np.abs(radius) + np.abs(of_rim_cells) + REACH_CELLS
    is_behind: Bools = is_near & (radius - of_rim_cells > MIN_STEP_CELLS)
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
    lit_rows: tuple[int, int]

    @classmethod
    def of(cls, scene: SceneLike, layer: Layer, images: Images, spectrum_w_m2_sr_nm: Floats) -> LayerLight:
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
            layer.rows(images.shape[2]),
        )


#: Function of (light, layer, is_cover) that returns the rows of the maps of all outputs, without relative illumination.
MapsOfLayer = Callable[[LayerLight, Layer, bool], Iterator[MapRows]]


def mean_spectrum(scene: SceneLike) -> Floats:
    """Return the mean spectral radiance of a scene, (n_wavelength,); 1 if it is dark."""
    means = np.array([in_memory(image).mean(dtype=np.float64) for image in scene.basis])
    found = np.asarray(np.einsum("b,bk->k", means, scene.spectrum_w_m2_sr_nm))
    return found if found.any() else np.ones(found.size)


def composed_maps(
    scene: SceneLike,
    layers: Layers,
    maps_of: MapsOfLayer,
    cover: Floats,
    shape: tuple[int, int],
    real: Any,
    n_threads: int,
) -> NDArray[Any]:
    """
    Return the maps (n_output, n_y, n_x) of layers that cover each other.

    Relative illumination is not applied. The spectra of one layer are in memory at a time. ``cover`` (n_output,): outputs for
    the mean spectrum of the scene.
    """
    from foveasim.optics._kernels import add_layer

    total, left = np.zeros((cover.size, *shape), real), np.ones((cover.size, *shape), real)
    white = mean_spectrum(scene)[np.newaxis]
    pixels, covers = np.zeros(scene.basis.shape, scene.basis.dtype), np.zeros((1, *layers.shape), real)
    blocks = range(0, shape[0], ROWS_TOGETHER)
    is_filled = np.zeros((cover.size, len(blocks)), bool)
    for layer in layers.layers:
        layer.write(None, covers)
        layer.write(scene.basis, pixels)
        of_cover = maps_of(LayerLight.of(scene, layer, covers, white), layer, True)
        of_light = maps_of(LayerLight.of(scene, layer, pixels, scene.spectrum_w_m2_sr_nm), layer, False)
        for c, (rows_of_cover, rows_of_light) in enumerate(zip(of_cover, of_light, strict=True)):
            if cover[c] == 0.0:
                continue

            def add(
                first: int, c: int = c, rows_of_cover: MapRows = rows_of_cover, rows_of_light: MapRows = rows_of_light
            ) -> None:
                last, block = min(first + ROWS_TOGETHER, shape[0]), first // ROWS_TOGETHER
                if not is_filled[c, block]:
                    share, light = rows_of_cover(first, last), rows_of_light(first, last)
                    is_filled[c, block] = add_layer(
                        share, light, real(1.0 / cover[c]), total[c, first:last], left[c, first:last]
                    )

            parallel_map(add, blocks, n_threads)
        layer.fill(covers, 0.0)
        layer.fill(pixels, 0.0)

    def divide(first: int) -> None:
        rows = slice(first, first + ROWS_TOGETHER)
        total[:, rows] /= np.maximum(1.0 - left[:, rows], real(MIN_SHARE))

    parallel_map(divide, blocks, n_threads)
    return total


def fine_pixels(layers: Layers, n_fine: int) -> Layers:
    """Return the layers of pixels that are divided into n x n cells."""
    if n_fine == 1:
        return layers
    n_y, n_x = layers.shape

    def cells_of(pixels: Ints) -> Ints:
        row, column = (n_fine * part[:, np.newaxis] + np.arange(n_fine) for part in np.divmod(pixels, n_x))
        return np.asarray(n_fine * n_x * row[:, :, np.newaxis] + column[:, np.newaxis]).reshape(-1)

    fine = [
        Layer(each.distance_m, *(cells_of(part) for part in (each.visible, each.hidden, each.rim)))
        for each in layers.layers
    ]
    return Layers(fine, (n_fine * n_y, n_fine * n_x))


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
        both = np.zeros((2, *layers.shape))
        layer.write(None, both[:1])
        layer.write(images, both[1:])
        parts.append((*both, shifts_cells(layer, points)))
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
