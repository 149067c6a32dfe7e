"""
Rendering of three-dimensional scenes, with PyVista or in software.

Both renderers share the viewpoint, one light source, flat shading and anti-aliasing, so that their pictures agree. PyVista
needs OpenGL, and adds windows and ambient occlusion; the software renderer has no requirements.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, POSITIVE, Limits, check_declared
from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Floats, check_count, check_shape, finite_array
from foveasim._io.images import write_picture
from foveasim.capture import Capture
from foveasim.errors import FoveasimWarning, GeometryError, ParameterError, SimulationError, warn
from foveasim.layout import Layout
from foveasim.view._annotations import Label, add_strip, strip_width_px
from foveasim.view._ipython import display, is_notebook
from foveasim.view.meshes import Mesh, import_pyvista, prisms
from foveasim.view.renderer import ON_SCREEN, begin_rendering, find_renderer, missing_software

if TYPE_CHECKING:
    from pyvista import Plotter, PolyData

__all__ = ["SceneOfMeshes", "Viewpoint", "plotter", "render", "show", "show_columns", "sites_in_view"]

#: Ambient reflection of every face, and additional reflection of a face toward the light source. Their sum is 1, so that no
#: colour is clipped.
AMBIENT, DIFFUSE = 0.35, 0.65
#: Direction toward the light source in components to the right, horizontally toward the viewer, and up.
LIGHT_DIRECTION = (-0.38, 0.30, 0.87)
#: Background with contrast to both light and dark colours.
BACKGROUND = (238, 240, 244)
#: The scene fills this fraction of the picture's narrower direction.
FILLED_FRACTION = 0.94
#: Number of points that determine the viewing distance.
FRAMING_POINTS = 50_000
#: Bisections that locate the centre of the scene to a thousandth of a pixel.
CENTRING_STEPS = 24
#: Margin that is rendered and cropped: ambient occlusion has a line artefact at the picture boundary.
OCCLUSION_MARGIN_PX = 16
#: Radius of ambient occlusion as a fraction of the scene's size.
OCCLUSION_RADIUS_FRACTION = 0.02
#: Bias of ambient occlusion as a fraction of its radius: a smaller bias shows the steps of the depth buffer as hatching.
OCCLUSION_BIAS_FRACTION = 0.1
#: Scenes of more triangles have one sample per pixel by default, which renders them in seconds.
MAX_OVERSAMPLED_TRIANGLES = 1_000_000
#: Smallest fraction of a picture's width that remains for the scene.
MIN_SCENE_FRACTION = 0.3
#: Distance of the end of a label's line from the outline of its part.
LABEL_INSET_PX = 3
#: Right part of a plotter's window for the scalar bar.
BAR_FRACTION = 0.14
#: Text and colour of the photosite that is picked in a window.
PICKING_HINT = "right click: photosite"
PICKED_TEXT: Mapping[str, Any] = {"position": (12, 12), "font_size": 11, "color": "black", "name": "picked site"}
PICKED_COLOUR = (255, 140, 0)
#: Largest side of a picture, to catch mistakes.
MAX_SIDE_PX = 32_768

RgbArray: TypeAlias = NDArray[np.uint8]


@runtime_checkable
class SceneOfMeshes(Protocol):
    """Protocol of objects that consist of meshes, such as :class:`foveasim.view.Solids`."""

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """Parts of the scene."""


Renderable: TypeAlias = Mesh | Iterable[Mesh] | SceneOfMeshes | Layout | Capture


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewpoint:
    """
    Viewing direction, zoom and angle of view of a scene.

    The distance of the viewer is such that the scene fills the picture.

    Parameters
    ----------
    azimuth_deg : float
        Azimuth of the viewer, counter-clockwise from +x: at -90, x points to the right.
    elevation_deg : float
        Elevation of the viewer over the sensor plane, from -90 to 90.
    zoom : float
        Magnification: 2 doubles all lengths in the picture.
    focus_um : (x, y, z), optional, µm
        Point in the centre of the picture; the centre of the scene by default.
    view_deg : float
        Vertical angle of view: small angles flatten the perspective, large angles exaggerate it.

    Examples
    --------
    >>> import foveasim as fs
    >>> from_above = fs.view.Viewpoint(azimuth_deg=-90.0, elevation_deg=90.0)
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0)
    >>> fs.view.render(
    ...     layout,
    ...     viewpoint=from_above,
    ...     size_px=(120, 120),
    ...     renderer="software",
    ...     legend=False,
    ... ).shape
    (120, 120, 3)
    """

    azimuth_deg: Annotated[float, FINITE] = -65.0
    elevation_deg: Annotated[float, Limits(at_least=-90.0, at_most=90.0)] = 38.0
    zoom: Annotated[float, POSITIVE] = 1.0
    focus_um: tuple[float, float, float] | None = None
    view_deg: Annotated[float, Limits(at_least=1.0, at_most=120.0)] = 25.0

    def __post_init__(self) -> None:
        check_declared(self)
        if self.focus_um is not None and finite_array("focus_um", self.focus_um).shape != (3,):
            raise ParameterError("focus_um", "must be three numbers (x, y, z)", self.focus_um, "µm")


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """Viewpoint for a given scene and picture size."""

    position_um: Floats
    focus_um: Floats
    axes: Floats
    """(3, 3): unit vectors to the right, up and toward the viewer."""
    focal_px: float
    view_deg: float

    def project(self, points_um: Floats, size_px: tuple[int, int]) -> Floats:
        """Project points to pixels, x to the right and y down, and inverse depth, (n_point, 3)."""
        visible = (points_um - self.position_um) @ self.axes.T  # to the right, up, toward the viewer
        with np.errstate(divide="ignore"):
            np.divide(-1.0, visible[:, 2], out=visible[:, 2])
        visible[:, 0] *= self.focal_px * visible[:, 2]
        visible[:, 1] *= -self.focal_px * visible[:, 2]
        visible[:, :2] += 0.5 * np.array(size_px)
        return np.asarray(visible)


def render(
    scene: Renderable,
    path: str | Path | None = None,
    *,
    viewpoint: Viewpoint | None = None,
    size_px: tuple[int, int] = (1600, 1000),
    oversampling: Annotated[int, Limits(at_least=1, at_most=8)] | None = None,
    ambient_occlusion: bool = False,
    background: tuple[int, int, int] = BACKGROUND,
    renderer: Literal["auto", "pyvista", "software"] = "auto",
    legend: bool | None = None,
    labels: bool = False,
) -> RgbArray:
    """
    Render a scene to a picture, off screen.

    Parameters
    ----------
    scene : Mesh, sequence of Mesh, Solids, Layout or Capture
        A layout or a capture is shown as columns; see :func:`foveasim.view.prisms`.
    path : path, optional
        File to which the picture is also written; its extension selects the format.
    viewpoint : Viewpoint, optional
    size_px : (int, int)
        Width and height of the picture.
    oversampling : int, optional
        Each pixel is the mean of n x n samples; 1 has jagged edges and is faster. By default 2, and 1 for scenes of more than
        a million triangles.
    ambient_occlusion : bool
        Whether to darken corners and gaps by ambient occlusion; PyVista only.
    background : (r, g, b)
        Colour behind the scene.
    renderer : {"auto", "pyvista", "software"}
        By default PyVista if it can render, otherwise the software renderer, with a warning that names the missing software.
    legend : bool, optional
        Whether to show the colour bar or the legend of the first mesh that has one, on the right side; by default for a
        layout or a capture.
    labels : bool
        Whether to show names and thicknesses of the parts, on the right side.

    Returns
    -------
    picture : (n_y, n_x, 3) uint8
        Top row first.

    Raises
    ------
    FileError
        When the file cannot be written.
    GeometryError
        When the scene is empty.
    SimulationError
        When ``renderer="pyvista"`` and PyVista cannot render on this machine.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0)
    >>> picture = fs.view.render(
    ...     layout, size_px=(160, 100), renderer="software", legend=False
    ... )
    >>> picture.shape, picture[0, 0].tolist()  # the background
    ((100, 160, 3), [238, 240, 244])
    """
    meshes = _meshes(scene)
    legend = isinstance(scene, Layout | Capture) if legend is None else legend
    if oversampling is None:
        oversampling = 2 if sum(mesh.triangles.shape[0] for mesh in meshes) <= MAX_OVERSAMPLED_TRIANGLES else 1
    total_x, n_y = _size(size_px, oversampling)
    shown = next((mesh.shown for mesh in meshes if mesh.shown is not None), None) if legend else None
    texts = [_part_text(mesh) for mesh in meshes] if labels else []
    n_x = total_x - sum(strip_width_px(shown, texts, n_y))
    if n_x < MIN_SCENE_FRACTION * total_x:
        raise ParameterError(
            "size_px",
            f"must leave space for the scene, got {size_px}",
            hint="use a larger picture, or legend=False and labels=False",
        )
    if finite_array("background", background).shape != (3,) or not all(0 <= part <= 255 for part in background):
        raise ParameterError("background", "must be three numbers from 0 to 255", background)
    missing = "" if renderer == "software" else missing_software()
    if missing and renderer == "pyvista":
        raise SimulationError(missing)
    if missing:
        warn(f"{missing}; the software renderer is used", FoveasimWarning)
    # Ambient occlusion has a line artefact at the picture boundary, which is cropped.
    margin = OCCLUSION_MARGIN_PX * oversampling if ambient_occlusion and not missing and renderer != "software" else 0
    width, height = n_x * oversampling, n_y * oversampling
    eye = _eye(meshes, viewpoint or Viewpoint(), (width, height))
    if renderer == "software" or missing:
        large = _render_in_software(meshes, eye, (width, height), background)
    else:
        large = _render_with_pyvista(meshes, eye, (width, height), background, ambient_occlusion, margin)
    picture = _average_samples(large, oversampling)
    if n_x < total_x:
        marks = _labels(meshes, texts, eye, (width, height), oversampling) if labels else []
        picture = add_strip(picture, shown, marks, background)
    if path is not None:
        write_picture(path, picture)
    return picture


def sites_in_view(
    scene: Renderable, *, viewpoint: Viewpoint | None = None, size_px: tuple[int, int] = (1600, 1000)
) -> NDArray[np.int32]:
    """
    Return the photosite visible in each pixel of the picture by :func:`render`.

    Parameters
    ----------
    scene, viewpoint, size_px
        As for :func:`render`.

    Returns
    -------
    site : (n_y, n_x) int32
        Top row first; -1 where no photosite is visible.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0)
    >>> site = fs.view.sites_in_view(
    ...     layout, viewpoint=fs.view.Viewpoint(elevation_deg=90.0), size_px=(160, 100)
    ... )
    >>> np.unique(site).size - 1  # all sites from above, and the background
    16
    """
    meshes = _meshes(scene)
    n_x, n_y = _size(size_px, 1)
    eye = _eye(meshes, viewpoint or Viewpoint(), (n_x, n_y))
    ids, _ = _nearest(meshes, eye, (n_x, n_y))
    first = np.concatenate([mesh.photosite[mesh.triangles[:, 0]] for mesh in meshes])
    return np.where(ids < 0, np.int32(-1), first[ids])


def plotter(
    scene: Renderable,
    *,
    viewpoint: Viewpoint | None = None,
    size_px: tuple[int, int] = (1600, 1000),
    off_screen: bool = False,
) -> Plotter:
    """
    Return a PyVista plotter of a scene, for changes before ``show`` or ``screenshot``.

    Parameters
    ----------
    scene, viewpoint, size_px
        As for :func:`render`.
    off_screen : bool
        Whether to render without a window.

    Returns
    -------
    pyvista.Plotter
        With one actor per mesh, by its name; a scalar bar with quantity and unit; and, in a window, the photosite and its
        value at a right click.

    Raises
    ------
    GeometryError
        When the scene is empty.
    SimulationError
        When this machine has no OpenGL or no PyVista.

    Examples
    --------
    >>> import foveasim as fs
    >>> plotter = fs.view.plotter(
    ...     fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0), off_screen=True
    ... )  # doctest: +SKIP
    >>> plotter.add_text("16 photosites")  # doctest: +SKIP
    >>> plotter.screenshot("columns.png")  # doctest: +SKIP
    """
    meshes = _meshes(scene)
    size = _size(size_px, 1)
    missing = missing_software()
    if missing:
        raise SimulationError(missing)
    eye = _eye(meshes, viewpoint or Viewpoint(), size)
    plot = _plotter(meshes, eye, size, BACKGROUND, off_screen=off_screen)
    _add_scalar_bar(plot, meshes)
    if not off_screen:
        add_picking(plot, meshes)
    return plot


def show(scene: Renderable, *, viewpoint: Viewpoint | None = None, size_px: tuple[int, int] = (1600, 1000)) -> None:
    """
    Show a scene in an interactive window until the window is closed.

    In a notebook on a machine without a screen, a picture of :func:`render` is shown instead.

    Parameters
    ----------
    scene, viewpoint, size_px
        As for :func:`plotter`.

    Raises
    ------
    SimulationError
        Outside notebooks, when this machine has no screen, no OpenGL or no PyVista; the message names a remedy.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor_stack = fs.view.SensorStack(well_depth_um=3.0, trench_width_um=0.3)
    >>> model = fs.view.stack(fs.layout.grid(n_x=6, n_y=6, pitch_um=3.0), sensor_stack)
    >>> fs.view.show(model)  # doctest: +SKIP
    """
    meshes = _meshes(scene)
    missing = missing_software()
    if (missing or find_renderer() not in ON_SCREEN) and is_notebook():
        from PIL import Image

        display(Image.fromarray(render(scene, viewpoint=viewpoint, size_px=size_px, legend=True)))
        return
    if missing:
        raise SimulationError(missing)
    if find_renderer() not in ON_SCREEN:
        raise SimulationError(
            "this machine has no screen to open a window on; write a picture with foveasim.view.render(scene, 'picture.png')"
        )
    plotter(meshes, viewpoint=viewpoint, size_px=size_px).show()


def show_columns(
    data: Layout | Capture,
    height: str | ArrayLike | None = None,
    *,
    by: str | ArrayLike | None = None,
    max_height_um: float | None = None,
    viewpoint: Viewpoint | None = None,
    size_px: tuple[int, int] = (1600, 1000),
) -> None:
    """
    Show photosites as columns in an interactive window, with a scalar bar.

    Parameters
    ----------
    data : Layout or Capture
    height, by, max_height_um
        As for :func:`foveasim.view.prisms`.
    viewpoint, size_px
        As for :func:`render`.

    Raises
    ------
    ParameterError, GeometryError
        As for :func:`foveasim.view.prisms`.
    SimulationError
        As for :func:`show`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(
    ...     n_sectors=64, n_rings=16, r_min_um=20.0, r_max_um=100.0
    ... )
    >>> fs.view.show_columns(layout, "size_um", max_height_um=20.0)  # doctest: +SKIP
    """
    show(prisms(data, height, by=by, max_height_um=max_height_um), viewpoint=viewpoint, size_px=size_px)


# -- both renderers ------------------------------------------------------------------------------------------------------


def _meshes(scene: Renderable) -> list[Mesh]:
    if isinstance(scene, Layout | Capture):
        found: list[Any] = [prisms(scene)]
    elif isinstance(scene, Mesh):
        found = [scene]
    elif isinstance(scene, SceneOfMeshes):
        found = list(scene.meshes)
    else:
        found = list(scene) if isinstance(scene, Iterable) else [scene]
    if not all(isinstance(mesh, Mesh) for mesh in found):
        raise ParameterError("scene", "must be a Layout, a Capture, a Mesh, a sequence of meshes, or Solids", scene)
    found = [mesh for mesh in found if mesh.triangles.size]
    if not found:
        raise GeometryError("the scene is empty; it must have at least one triangle")
    return found


def _size(size_px: tuple[int, int], oversampling: int) -> tuple[int, int]:
    n_x, n_y = check_shape("size_px", size_px)
    for n in (n_x, n_y):
        check_count("size_px", n, at_most=MAX_SIDE_PX // oversampling)
    return n_x, n_y


def _eye(meshes: list[Mesh], viewpoint: Viewpoint, size_px: tuple[int, int]) -> _Eye:
    """Place the viewer at the distance at which the scene just fits, centred in the picture."""
    azimuth, elevation = np.radians(viewpoint.azimuth_deg), np.radians(viewpoint.elevation_deg)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    axes = np.stack((right, np.cross(toward, right), toward))
    focal_px = 0.5 * size_px[1] / np.tan(0.5 * np.radians(viewpoint.view_deg))
    points = np.concatenate([_framing_points(mesh) for mesh in meshes])
    low, high = points.min(axis=0), points.max(axis=0)
    centre_um, size_um = 0.5 * (low + high), float(np.linalg.norm(high - low))
    reach = FILLED_FRACTION * 0.5 * np.array(size_px) / focal_px
    visible = (points - centre_um) @ axes.T
    across_um, toward_um = visible[:, :2], visible[:, 2:]
    # A point at s across and z toward the viewer is visible when |s - offset| <= reach (distance - z). Both limits are lines
    # in the offset, whose intersection is the smallest distance that satisfies both.
    from_right, from_left = (np.max(sign * across_um / reach + toward_um, axis=0) for sign in (1.0, -1.0))
    if viewpoint.focus_um is None:
        distance = _limit_distance(float(np.max(0.5 * (from_right + from_left))), toward_um, size_um)
        offset = _centring_offset(across_um, distance - toward_um)
        focus_um = centre_um + offset @ axes[:2]
    else:
        focus_um = np.array(viewpoint.focus_um, dtype=np.float64)
        offset = (focus_um - centre_um) @ axes.T
        needed = np.maximum(from_right - offset[:2] / reach, from_left + offset[:2] / reach)
        distance = _limit_distance(float(np.max(needed)), toward_um, size_um) - offset[2]
    return _Eye(focus_um + distance * toward, focus_um, axes, focal_px * viewpoint.zoom, viewpoint.view_deg)


def _limit_distance(distance_um: float, toward_um: Floats, size_um: float) -> float:
    """
    Limit the distance to at least slightly in front of the nearest point.

    This matters for a flat scene viewed along its plane.
    """
    return max(distance_um, float(toward_um.max()) + 1e-3 * size_um)


def _centring_offset(across_um: Floats, before_um: Floats) -> Floats:
    """Return the offset at which the outermost points are equally far from the centre, (2,)."""
    low, high = across_um.min(axis=0), across_um.max(axis=0)
    for _ in range(CENTRING_STEPS):
        centre = 0.5 * (low + high)
        tangent = (across_um - centre) / before_um
        is_left = tangent.max(axis=0) + tangent.min(axis=0) > 0.0
        low, high = np.where(is_left, centre, low), np.where(is_left, high, centre)
    return np.asarray(0.5 * (low + high))


def _framing_points(mesh: Mesh) -> Floats:
    """Return a subset of the points of a mesh that includes its extreme points."""
    step = max(1, mesh.points_um.shape[0] // FRAMING_POINTS)
    extremes = np.concatenate((mesh.points_um.argmin(axis=0), mesh.points_um.argmax(axis=0)))
    return np.concatenate((mesh.points_um[::step], mesh.points_um[extremes]))


def _light_direction(eye: _Eye) -> Floats:
    """Return the unit vector toward the light source, which moves with the viewer."""
    right = eye.axes[0]
    ahead = np.array([right[1], -right[0], 0.0])  # horizontal, toward the viewer
    light = LIGHT_DIRECTION[0] * right + LIGHT_DIRECTION[1] * ahead + LIGHT_DIRECTION[2] * np.array([0.0, 0.0, 1.0])
    return np.asarray(light / np.linalg.norm(light))


def _average_samples(large: RgbArray, oversampling: int) -> RgbArray:
    """Average each square of samples."""
    if oversampling == 1:
        return large
    n_y, n_x = (n // oversampling for n in large.shape[:2])
    total = np.zeros((n_y, n_x, 3), np.uint16)
    for row in range(oversampling):
        for column in range(oversampling):
            total += large[row::oversampling, column::oversampling]
    return ((total + oversampling**2 // 2) // oversampling**2).astype(np.uint8)


# -- software renderer --------------------------------------------------------------------------------------------------


def _nearest(meshes: list[Mesh], eye: _Eye, size_px: tuple[int, int]) -> tuple[NDArray[np.int32], Floats]:
    """Return the nearest triangle (-1 for none) and its inverse depth, (n_y, n_x) each."""
    from foveasim.view import _zbuffer_kernels

    draw = _zbuffer_kernels.draw_triangles
    n_x, n_y = size_px
    ids, nearness = np.full((n_y, n_x), -1, np.int32), np.zeros((n_y, n_x))
    n_threads = thread_count()
    limits = np.linspace(0, n_y, n_threads + 1).astype(int)
    first_id = 0
    for mesh in meshes:
        screen = eye.project(mesh.points_um, size_px)

        def draw_band(k: int, mesh: Mesh = mesh, screen: Floats = screen, first_id: int = first_id) -> None:
            draw(screen, mesh.triangles, first_id, limits[k], limits[k + 1], nearness, ids)

        parallel_map(draw_band, range(n_threads), n_threads)
        first_id += mesh.triangles.shape[0]
    return ids, nearness


def _render_in_software(
    meshes: list[Mesh], eye: _Eye, size_px: tuple[int, int], background: tuple[int, int, int]
) -> RgbArray:
    """Render with the z-buffer; only visible triangles are shaded."""
    ids, _ = _nearest(meshes, eye, size_px)
    n_x, n_y = size_px
    picture = np.empty((n_y, n_x, 3), np.uint8)
    picture[:] = background
    first_id = 0
    light = _light_direction(eye)
    for mesh in meshes:
        is_here = (ids >= first_id) & (ids < first_id + mesh.triangles.shape[0])
        visible, which = np.unique(ids[is_here] - first_id, return_inverse=True)
        corners = mesh.triangles[visible]
        if mesh.is_smooth:
            normal = _smooth_normals(mesh, corners, which, np.argwhere(is_here), eye, size_px)
            bright = AMBIENT + DIFFUSE * np.clip(normal @ light, 0.0, 1.0)
            colours = mesh.colours[corners[:, 0]][which]
            picture[is_here] = np.rint(colours * bright[:, np.newaxis]).astype(np.uint8)
            first_id += mesh.triangles.shape[0]
            continue
        a, b, c = (mesh.points_um[corners[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(np.float64).tiny)
        bright = AMBIENT + DIFFUSE * np.clip(normal @ light / length, 0.0, 1.0)
        lit = np.rint(mesh.colours[corners[:, 0]] * bright[:, np.newaxis]).astype(np.uint8)
        picture[is_here] = lit[which]
        first_id += mesh.triangles.shape[0]
    return picture


def _face_normals(points_um: Floats, triangles: NDArray[np.int32]) -> Floats:
    """Return normals whose lengths are twice the areas, (n_triangle, 3)."""
    a, b, c = (points_um[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def point_normals(mesh: Mesh) -> Floats:
    """Return the mean normal of the triangles facing up at each point, (n_point, 3)."""
    faces = _face_normals(mesh.points_um, mesh.triangles)
    faces[faces[:, 2] <= 0.0] = 0.0
    normal = np.stack(
        [np.bincount(mesh.triangles.ravel(), np.repeat(faces[:, k], 3), mesh.points_um.shape[0]) for k in range(3)],
        axis=1,
    )
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float64).tiny)


def _smooth_normals(
    mesh: Mesh,
    corners: NDArray[np.int32],
    which: NDArray[np.int64],
    pixels: NDArray[np.int64],
    eye: _Eye,
    size_px: tuple[int, int],
) -> Floats:
    """
    Interpolate point normals at pixels (row, column) of ``corners[which]``.

    Faces that do not face up have their own normals.
    """
    screen = eye.project(mesh.points_um, size_px)
    a, b, c = (screen[corners[:, k]][which] for k in range(3))
    y, x = pixels[:, 0] + 0.5, pixels[:, 1] + 0.5
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    area = np.where(area == 0.0, 1.0, area)
    second = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
    third = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
    # Perspective: weights on the surface are those on the screen times the inverse depth.
    weight = np.clip(np.stack((1.0 - second - third, second, third), axis=1), 0.0, 1.0)
    weight *= np.stack((a[:, 2], b[:, 2], c[:, 2]), axis=1)
    mean = np.einsum("ij,ijk->ik", weight, point_normals(mesh)[corners][which])
    flat = _face_normals(mesh.points_um, corners)[which]
    normal = np.where(flat[:, 2:] > 0.0, mean, flat)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float64).tiny)


# -- labels --------------------------------------------------------------------------------------------------------------


def _part_text(mesh: Mesh) -> str:
    """Return the name and the thickness of a part."""
    low, high = mesh.bounds_um
    return f"{mesh.name} {high[2] - low[2]:.3g} µm"


def _labels(
    meshes: list[Mesh], texts: list[str], eye: _Eye, size_px: tuple[int, int], oversampling: int
) -> list[Label]:
    """Return labels of the visible parts, at the right end of their visible area."""
    from scipy.ndimage import binary_erosion

    ids, _ = _nearest(meshes, eye, size_px)
    labels, first_id = [], 0
    for mesh, text in zip(meshes, texts, strict=True):
        is_here = (ids >= first_id) & (ids < first_id + mesh.triangles.shape[0])
        first_id += mesh.triangles.shape[0]
        # Well inside, if the part is large enough.
        inner = binary_erosion(is_here, iterations=LABEL_INSET_PX * oversampling)
        rows, columns = np.nonzero(inner if inner.any() else is_here)
        if rows.size:
            last = columns.argmax()
            labels.append(Label(text, columns[last] / oversampling, rows[last] / oversampling))
    return labels


# -- PyVista ------------------------------------------------------------------------------------------------------------


def _render_with_pyvista(
    meshes: list[Mesh],
    eye: _Eye,
    size_px: tuple[int, int],
    background: tuple[int, int, int],
    ambient_occlusion: bool,
    margin_px: int,
) -> RgbArray:
    """Render with VTK; a margin is rendered around the picture and cropped."""
    n_x, n_y = size_px
    plotter = _plotter(meshes, eye, (n_x + 2 * margin_px, n_y + 2 * margin_px), background, off_screen=True)
    try:
        if ambient_occlusion:
            size_um = float(np.linalg.norm(np.ptp(np.stack([b for m in meshes for b in m.bounds_um]), axis=0)))
            radius_um = OCCLUSION_RADIUS_FRACTION * size_um
            plotter.enable_ssao(radius=radius_um, bias=OCCLUSION_BIAS_FRACTION * radius_um, kernel_size=64, blur=True)
        large = np.asarray(plotter.screenshot(None, return_img=True))
    finally:
        plotter.close()
    return large[margin_px : margin_px + n_y, margin_px : margin_px + n_x, :3]


def _plotter(
    meshes: list[Mesh], eye: _Eye, size_px: tuple[int, int], background: tuple[int, int, int], *, off_screen: bool
) -> Plotter:
    """
    Return a PyVista plotter of the scene.

    One light source and, off screen, no multisampling are several times as fast as the defaults of PyVista.
    """
    begin_rendering()
    pyvista = import_pyvista()
    plotter = pyvista.Plotter(off_screen=off_screen, window_size=list(size_px), lighting="none")
    plotter.render_window.SetMultiSamples(0 if off_screen else 4)
    plotter.set_background([part / 255.0 for part in background])
    light = pyvista.Light(
        position=tuple(_light_direction(eye)), focal_point=(0.0, 0.0, 0.0), light_type="scene light", intensity=1.0
    )
    plotter.add_light(light)
    for mesh in meshes:
        surface = mesh.to_pyvista()
        if mesh.is_smooth:
            _split_at_rims(surface, mesh)
        surface.points = surface.points.astype(
            np.float32
        )  # native type of graphics cards; VTK would convert element by element
        plotter.add_mesh(
            surface,
            scalars="rgb",
            rgb=True,
            culling="back",
            ambient=AMBIENT,
            diffuse=DIFFUSE,
            specular=0.0,
            smooth_shading=mesh.is_smooth,
            show_scalar_bar=False,
            copy_mesh=False,
            name=mesh.name,
        )
    camera = plotter.camera
    camera.position = tuple(eye.position_um)
    camera.focal_point = tuple(eye.focus_um)
    camera.up = tuple(eye.axes[1])
    # The angle of view includes the margin.
    camera.view_angle = float(np.degrees(2.0 * np.arctan(0.5 * size_px[1] / eye.focal_px)))
    plotter.reset_camera_clipping_range()
    return plotter


def _split_at_rims(surface: PolyData, mesh: Mesh) -> None:
    """
    Set the normals of a smooth mesh.

    Triangles facing up have the normals of their points; all others have separate points with their own normals.
    """
    is_up = _face_normals(mesh.points_um, mesh.triangles)[:, 2] > 0.0
    flat = mesh.triangles[~is_up]
    n = mesh.points_um.shape[0]
    triangles = mesh.triangles.astype(np.int64)
    triangles[~is_up] = n + np.arange(flat.size).reshape(-1, 3)
    normals = np.concatenate((point_normals(mesh), np.repeat(_face_normals(mesh.points_um, flat), 3, axis=0)))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    surface.points = np.concatenate((mesh.points_um, mesh.points_um[flat.ravel()]))
    surface.faces = np.column_stack((np.full(triangles.shape[0], 3), triangles)).ravel()
    surface.point_data.active_normals = normals


def _add_scalar_bar(plot: Plotter, meshes: list[Mesh]) -> None:
    """Add the colour bar or legend of the first mesh that has one, right of the scene."""
    from matplotlib.colors import ListedColormap

    pyvista = import_pyvista()
    shown = next((mesh.shown for mesh in meshes if mesh.shown is not None), None)
    if shown is None or (shown.scale is None and not shown.legend):
        return
    plot.camera.SetWindowCenter(BAR_FRACTION, 0.0)
    plot.camera.zoom(1.0 - BAR_FRACTION)
    if shown.scale is not None:
        steps = np.linspace(0.0, 1.0, 256)
        colours = shown.scale.colours(shown.scale.low + (shown.scale.high - shown.scale.low) * steps)
        table = pyvista.LookupTable(ListedColormap(colours / 255.0), n_values=256)
        table.scalar_range = (shown.scale.low, shown.scale.high)
        mapper = pyvista.DataSetMapper()
        mapper.lookup_table = table
        mapper.scalar_range = table.scalar_range
        plot.add_scalar_bar(
            title=f"{shown.title}\n",
            mapper=mapper,
            color="black",
            vertical=True,
            fmt="%.4g",
            position_x=0.89,
            position_y=0.2,
            width=0.05,
            height=0.6,
            title_font_size=20,
            label_font_size=18,
        )
    else:
        labels = [[name, [part / 255.0 for part in rgb]] for name, rgb in shown.legend]
        plot.add_legend(
            labels, bcolor=None, face="rectangle", size=(0.1, 0.05 * len(labels)), loc="center right", border=False
        )


def add_picking(plot: Plotter, meshes: list[Mesh]) -> None:
    """Show number and value of a photosite at a right click; draw it in another colour."""
    repainted: list[tuple[Any, Any, Any]] = []

    def report(_: Any, picker: Any) -> None:
        while repainted:
            surface, cells, colours = repainted.pop()
            surface.cell_data["rgb"][cells] = colours
            surface.Modified()
        actor, cell = picker.GetActor(), picker.GetCellId()
        part = next((mesh for mesh in meshes if actor is not None and actor is plot.actors.get(mesh.name)), None)
        if part is None or cell < 0:
            plot.add_text(PICKING_HINT, **PICKED_TEXT)
            plot.render()
            return
        surface = actor.mapper.dataset
        site = int(surface.cell_data["site"][cell])
        quantity, _, unit = part.title.partition(" / ")
        value = f"{quantity} {surface.cell_data[part.title][cell]:.6g} {unit}" if part.title else part.name
        plot.add_text(f"site {site}, {value}".rstrip(), **PICKED_TEXT)
        cells = np.flatnonzero(np.asarray(surface.cell_data["site"]) == site)
        repainted.append((surface, cells, surface.cell_data["rgb"][cells].copy()))
        surface.cell_data["rgb"][cells] = PICKED_COLOUR
        surface.Modified()
        plot.render()

    # Not pyvista's picking of elements, which searches the cell by its position and often misses.
    plot.enable_point_picking(
        report,
        picker="cell",
        tolerance=0.0,
        use_picker=True,
        pickable_window=True,
        show_point=False,
        show_message=False,
    )
    plot.add_text(PICKING_HINT, **PICKED_TEXT)
