"""
OpenEXR pictures: linear light in the primaries of Rec. ITU-R BT.709 or of the file.

The picture is the display window; pixels outside the data window are black. Colours are multiplied by alpha
("premultiplied"), so that the light is that of the colours alone, and alpha is not read. The picture is that of the channels
without a layer, or of the only layer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.images._limits import check_size, check_square_pixels
from foveasim.errors import printable

#: Attributes that are understood, here or by the library.
UNDERSTOOD = frozenset((
    *("channels", "chromaticities", "adoptedNeutral", "dataWindow", "displayWindow", "pixelAspectRatio", "multiView"),
    *("compression", "dwaCompressionLevel", "lineOrder", "tiles", "type", "version", "chunkCount", "maxSamplesPerPixel"),
    *("envmap", "deepImageState", "colorInteropID"),
))  # fmt: skip
#: Standard attributes that do not change relative light: notes, the camera, copies of the picture, rendering on displays, the
#: luminance of white (a scene specifies that of its own).
IRRELEVANT = frozenset((
    *("name", "view", "owner", "comments", "capDate", "utcOffset", "longitude", "latitude", "altitude", "focus", "expTime"),
    *("aperture", "isoSpeed", "keyCode", "timeCode", "framesPerSecond", "wrapmodes", "preview", "screenWindowCenter"),
    *("screenWindowWidth", "worldToCamera", "worldToNDC", "xDensity", "renderingTransform", "lookModTransform"),
    *("whiteLuminance", "originalDataWindow", "acesImageContainerFlag", "reelName", "imageCounter", "ascFramingDecisionList"),
    *("cameraMake", "cameraModel", "cameraSerialNumber", "cameraFirmwareVersion", "cameraUuid", "cameraLabel"),
    *("cameraColorBalance", "lensMake", "lensModel", "lensSerialNumber", "lensFirmwareVersion", "nominalFocalLength"),
    *("pinholeFocalLength", "effectiveFocalLength", "entrancePupilOffset", "tStop", "shutterAngle", "cameraCCTSetting"),
    *("cameraTintSetting", "cameraIdentifier", "sensorCenterOffset", "sensorOverallDimensions", "sensorPhotositePitch"),
    *("sensorAcquisitionRectangle", "captureRate", "timecodeRate", "storageEpSequence", "idManifest"),
))  # fmt: skip
#: Own attributes of programs are notes, unless their names contain one of these words.
COLOUR_WORDS = ("colorspace", "colourspace", "gamma", "transferfunction", "transferchar", "primaries", "iccprofile")
#: Values of such attributes, and of colorInteropID, that mean linear light in the primaries of BT.709 or of the file.
LINEAR_NAMES = frozenset((
    *("linear", "lin_rec709", "lin_rec709_scene", "lin_srgb", "linear rec.709", "linear rec.709 (srgb)", "scene_linear"),
    *("linear srgb", "scene-linear", "lin_rec709_srgb", "1", "1.0"),
))  # fmt: skip
#: Primaries (x, y) of red, green and blue, and white, by colorInteropID.
D65, ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
INTEROP_XY = {
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *ACES_WHITE),
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *ACES_WHITE),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    "lin_adobergb_scene": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65),
}
#: Channels of a picture, and those that are not light: depth. Alpha is understood: colours are premultiplied.
GREY, COLOURS, LUMINANCE_CHROMA = {"Y"}, {"R", "G", "B"}, {"Y", "RY", "BY"}
ALPHA, IRRELEVANT_CHANNELS = "A", {"Z", "ZBack"}


def read_exr(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """
    Read the picture of an EXR file, in the sandbox process.

    Returns ``primaries`` and ``neutral`` of the file, or None, and ``problem``, the reason why the colours are not defined.
    """
    path = Path(name)
    OpenEXR = import_optional(path, "OpenEXR")
    with OpenEXR.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise FormatError(f"contains {len(file.parts)} pictures; provide a file with one picture")
        header = dict(file.header())  # the file empties its own when it closes
        names = [channel.name for channel in header["channels"]]
    data, display = (_window(header[key]) for key in ("dataWindow", "displayWindow"))
    for window in (data, display):
        check_size(window[3] - window[1], window[2] - window[0])
    _check_attributes(header)
    channels = _channels_of_picture(names)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = file.channels()
        planes = [found[channel] for channel in channels]
        if any((plane.xSampling, plane.ySampling) != (1, 1) for plane in planes):
            raise FormatError("has subsampled channels; save it with all channels at full resolution")
        if any(plane.pixels.dtype.kind != "f" for plane in planes):
            raise FormatError("has channels of integers, which are not light; save it as half or float")
        pixels = np.stack([plane.pixels for plane in planes], axis=-1, dtype=np.float32)
    shape = (data[2] - data[0], data[3] - data[1])
    if pixels.shape[:2] != shape:
        raise FormatError(
            f"must have channels of {shape[1]} x {shape[0]} pixels, got {pixels.shape[1]} x {pixels.shape[0]}"
        )
    pixels = _in_display(pixels, data, display)
    return _colour(header), [pixels[..., 0] if len(channels) == 1 else pixels]


def _window(corners: Any) -> tuple[int, int, int, int]:
    """Return the first row and column of a window, and those after its last."""
    (x0, y0), (x1, y1) = (np.asarray(corner, dtype=np.int64).tolist() for corner in corners)
    if x1 < x0 or y1 < y0:
        raise FormatError("has an empty window")
    return y0, x0, y1 + 1, x1 + 1


def _in_display(pixels: NDArray[Any], data: tuple[int, ...], display: tuple[int, ...]) -> NDArray[Any]:
    """Return the pixels of the display window; black outside the data window."""
    if data == display:
        return pixels
    low, high = np.maximum(data[:2], display[:2]), np.minimum(data[2:], display[2:])
    if np.any(low >= high):
        raise FormatError("has no data in its display window; save it with a display window that contains the picture")
    found = np.zeros((display[2] - display[0], display[3] - display[1], pixels.shape[2]), np.float32)
    (y0, x0), (y1, x1) = (low - display[:2]).tolist(), (high - display[:2]).tolist()
    (v0, u0), (v1, u1) = (low - data[:2]).tolist(), (high - data[:2]).tolist()
    found[y0:y1, x0:x1] = pixels[v0:v1, u0:u1]
    return found


def _check_attributes(header: dict[str, Any]) -> None:
    check_square_pixels(float(header.get("pixelAspectRatio", 1.0)), 1.0, "pixelAspectRatio")
    if header.get("multiView"):
        views = ", ".join(printable(str(view)) for view in header["multiView"])
        raise FormatError(f"contains several views ({views:.60}); provide a file with one")
    if "deep" in str(header.get("type", "")):
        raise FormatError("contains deep data, several samples per pixel; flatten it")
    if "cube" in str(header.get("envmap", "")).lower():
        raise FormatError("contains the six faces of a cube (envmap); convert it to one picture")


def _channels_of_picture(names: list[str]) -> list[str]:
    """Return the channels of the picture in the order of grey or red, green and blue."""
    plain = {name for name in names if "." not in name}
    layers = {name.rpartition(".")[0] for name in names} - {""}
    if plain:
        prefix, parts = "", plain
    elif len(layers) == 1:
        prefix = f"{layers.pop()}."
        parts = {name.removeprefix(prefix) for name in names}
    else:
        raise FormatError(f"has several layers, {_listed(sorted(layers))}; save the one of the picture alone")
    light = parts - {ALPHA} - IRRELEVANT_CHANNELS
    if light == LUMINANCE_CHROMA:
        raise FormatError("has channels of luminance and chroma (Y, RY, BY); save it as R, G, B")
    if light == COLOURS:
        return [f"{prefix}{name}" for name in "RGB"]
    if light == GREY:
        return [f"{prefix}Y"]
    raise FormatError(f"must have the channels of one picture, R, G, B or Y, got {_listed(sorted(names))}")


def _listed(names: list[str]) -> str:
    return f"{', '.join(repr(printable(name)) for name in names):.200}"


def _colour(header: dict[str, Any]) -> dict[str, Any]:
    """Return the primaries that the header states."""
    found: dict[str, Any] = {"primaries": None, "neutral": None, "problem": ""}
    if "chromaticities" in header:
        found["primaries"] = [float(number) for number in header["chromaticities"]]
    if "adoptedNeutral" in header:
        found["neutral"] = [float(number) for number in header["adoptedNeutral"]]
    for key, value in header.items():
        plain = key.lower().replace("_", "").replace("-", "").replace(" ", "")
        is_own = key not in UNDERSTOOD and key not in IRRELEVANT
        if key == "colorInteropID" and value in INTEROP_XY:
            found["primaries"] = found["primaries"] or list(INTEROP_XY[value])
        elif (key == "colorInteropID" or (is_own and any(word in plain for word in COLOUR_WORDS))) and str(
            value
        ).strip().lower() not in LINEAR_NAMES:
            found["problem"] = f"has the attribute {printable(key)!r:.60} with the value {printable(str(value))!r:.60}"
    return found
