"""Pixels of video files: depth, matrix, range, transfer, primaries, alpha, orientation, and what is rejected."""

from __future__ import annotations

import io
import struct
from fractions import Fraction

import numpy as np
import pytest

import foveasim as fs
from foveasim._io.videos import VideoFile, frame_pixels
from foveasim._io.videos.colours import HLG_A, Colour
from foveasim._io.videos.files import Decoded
from foveasim._io.videos.pixels import check_frame, pixels_of_frame, turned
from foveasim.errors import FileError
from foveasim.scene import Scene
from foveasim.units import decode_srgb, encode_srgb
from foveasim.video import FrameSource, write_video

av = pytest.importorskip("av")
LIGHT = {"pitch_um": 10.0, "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 1.0}
#: Kr and Kb by numbers of ITU-T H.273.
WEIGHTS = {1: (0.2126, 0.0722), 2: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}


def uniform_frame(name, values, *, matrix=2, colour_range=0):
    """Return a frame of PyAV whose planes have values."""
    frame = av.VideoFrame(32, 16, name)
    for plane, value in zip(frame.planes, values, strict=True):
        depth = max(component.bits for component in frame.format.components)
        numbers = np.full(plane.buffer_size // (1 if depth == 8 else 2), value, np.uint8 if depth == 8 else "<u2")
        plane.update(numbers.tobytes())
    frame.colorspace, frame.color_range = matrix, colour_range
    return frame


def colour_by_formula(y, cb, cr, *, bits, matrix, is_full):
    """Return R, G, B of ITU-T H.273, 0 to 1."""
    step, peak = 2.0 ** (bits - 8), 2.0**bits - 1.0
    luma, blue, red = (y - (0 if is_full else 16 * step), cb - 128 * step, cr - 128 * step)
    luma /= peak if is_full else 219 * step
    blue, red = (value / (peak if is_full else 224 * step) for value in (blue, red))
    kr, kb = WEIGHTS[matrix]
    r, b = luma + 2 * (1 - kr) * red, luma + 2 * (1 - kb) * blue
    return np.clip([r, (luma - kr * r - kb * b) / (1 - kr - kb), b], 0.0, 1.0)


@pytest.mark.parametrize("matrix", WEIGHTS)
@pytest.mark.parametrize("colour_range", [0, 1, 2])
@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("yuv420p", 8),
        ("yuv444p", 8),
        ("yuv420p10le", 10),
        ("yuv422p10le", 10),
        ("yuv444p12le", 12),
        ("yuv444p16le", 16),
    ],
)
def test_luma_and_chroma_give_colours_of_standard(tmp_path, matrix, colour_range, name, bits):
    values = [v << (bits - 8) for v in (150, 100, 180)]
    pixels = pixels_of_frame(tmp_path, uniform_frame(name, values, matrix=matrix, colour_range=colour_range))
    peak = np.iinfo(pixels.dtype).max
    expected = colour_by_formula(*values, bits=bits, matrix=matrix, is_full=colour_range == 2)

    assert pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert pixels.shape == (16, 32, 3)
    np.testing.assert_allclose(pixels[8, 16] / peak, expected, atol=0.5 / peak + 1e-6)


def test_limited_range_has_black_and_white(tmp_path):
    for bits, name in ((8, "gray"), (10, "gray10le"), (16, "gray16le")):
        for colour_range, levels in ((1, (16, 235)), (0, (0, 255)), (2, (0, 255))):
            low, high = (round(v / 255 * (2**bits - 1)) if colour_range != 1 else v << (bits - 8) for v in levels)
            black, white = (
                pixels_of_frame(tmp_path, uniform_frame(name, [v], colour_range=colour_range)) for v in (low, high)
            )
            assert black.shape == (16, 32)
            assert black.max() == 0
            assert white.min() == np.iinfo(white.dtype).max


@pytest.mark.parametrize(
    ("codec", "name", "depth"),
    [("ffv1", "gray16le", 16), ("ffv1", "gray10le", 10), ("ffv1", "gray12le", 12), ("ffv1", "gbrp10le", 10),
     ("ffv1", "gbrp14le", 14), ("ffv1", "gbrp16le", 16), ("ffv1", "rgb48le", 16), ("ffv1", "gbrap16le", 16)],
)  # fmt: skip
def test_all_bits_of_lossless_videos_are_read(tmp_path, codec, name, depth):
    frame = av.VideoFrame(64, 48, name)
    rng, planes = np.random.default_rng(0), []
    for plane in frame.planes:
        numbers = rng.integers(0, 2**depth, (plane.height, plane.line_size // 2), dtype=np.uint16)
        plane.update(numbers.astype("<u2").tobytes())
        planes.append(numbers[:, : 64 * (3 if name == "rgb48le" else 1)])
    frame.pts = 0
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, name
        stream.options = {"level": "3", "strict": "experimental"}
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    (pixels,) = VideoFile(tmp_path / "a.mkv").pixels()
    if name == "rgb48le":
        expected = planes[0].reshape(48, 64, 3)
    else:
        expected = (
            planes[0] if len(planes) == 1 else np.stack([planes[k] for k in (2, 0, 1, 3)[: len(planes)]], axis=-1)
        )

    assert pixels.dtype == np.uint16
    np.testing.assert_array_equal(pixels, np.rint(expected * (65535 / (2**depth - 1))).astype(np.uint16))


def test_prores_keeps_ten_bits(tmp_path):
    ramp = np.linspace(0, 65535, 1024).astype(np.uint16)
    picture = np.broadcast_to(ramp[np.newaxis, :, np.newaxis], (64, 1024, 3)).copy()
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        stream = container.add_stream("prores_ks", rate=25)
        stream.width, stream.height, stream.pix_fmt = 1024, 64, "yuv422p10le"
        container.mux(
            stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb48le").reformat(format="yuv422p10le"))
        )
        container.mux(stream.encode())
    (pixels,) = VideoFile(tmp_path / "a.mov").pixels()

    assert pixels.dtype == np.uint16
    assert np.abs(pixels.astype(int) - picture).mean() < 200
    assert len(np.unique(pixels)) > 800


def tagged(path, picture, *, transfer=2, primaries=2, codec="libx264rgb", pixels="rgb24", frames=1):
    """Write a picture to a file with transfer and primaries."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = pixels
        stream.options = {"qp": "0"} if "264" in codec else {}
        stream.codec_context.color_trc, stream.codec_context.color_primaries = transfer, primaries
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


def grey_ramp():
    return np.broadcast_to(np.arange(256, dtype=np.uint8)[np.newaxis, :, np.newaxis], (16, 256, 3)).copy()


def bt709(v):
    """Return the inverse of the opto-electronic transfer of BT.709."""
    return np.where(v < 0.081, v / 4.5, ((v + 0.099) / 1.099) ** (1 / 0.45))


def hlg(v):
    """Return the inverse of the opto-electronic transfer of BT.2100, hybrid log-gamma."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(v <= 0.5, v**2 / 3, (np.exp((v - c) / a) + b) / 12)


@pytest.mark.parametrize(
    ("transfer", "curve", "tolerance"),
    [(2, decode_srgb, 1e-6), (13, decode_srgb, 1e-6), (1, bt709, 3e-4), (6, bt709, 3e-4), (14, bt709, 3e-4),
     (8, lambda v: v, 3e-5), (4, lambda v: v**2.2, 3e-5), (5, lambda v: v**2.8, 3e-5), (18, hlg, 3e-5)],
)  # fmt: skip
def test_transfer_of_file_gives_light(tmp_path, transfer, curve, tolerance):
    path = tagged(tmp_path / "a.mkv", grey_ramp(), transfer=transfer)
    (scene,) = FrameSource(path, **LIGHT)
    (raw,) = FrameSource(path, encoding="linear", **LIGHT)
    v = np.arange(256) / 255

    np.testing.assert_allclose(scene.basis[1, 0], curve(v), atol=tolerance)
    np.testing.assert_allclose(raw.basis[1, 0], v, atol=1e-7)
    assert pytest.approx(0.17883277) == HLG_A


@pytest.mark.parametrize("transfer", [7, 9, 10, 16, 17])
def test_other_transfers_are_named(tmp_path, transfer):
    path = tagged(tmp_path / "a.mkv", grey_ramp(), transfer=transfer)
    with pytest.raises(FileError, match=r"a\.mkv: has the transfer .*; convert it .* or specify the encoding"):
        list(FrameSource(path, **LIGHT))
    assert len(list(FrameSource(path, encoding="sqrt", **LIGHT))) == 1


def test_primaries_are_converted_to_srgb(tmp_path):
    # Linear Display P3 to linear sRGB, with the white D65 (matrices of colour-science).
    with np.printoptions():  # its import changes them
        colour = pytest.importorskip("colour")
    rng = np.random.default_rng(0)
    picture = rng.integers(120, 140, (16, 32, 3), dtype=np.uint8)
    names = {9: "ITU-R BT.2020", 12: "Display P3", 6: "SMPTE C"}
    for number, name in names.items():
        path = tagged(tmp_path / f"{number}.mkv", picture, transfer=13, primaries=number)
        (scene,) = FrameSource(path, **LIGHT)
        spaces = [colour.RGB_COLOURSPACES[space] for space in (name, "sRGB")]
        light = decode_srgb(picture / 255.0)
        xyz = light @ colour.normalised_primary_matrix(spaces[0].primaries, (0.3127, 0.3290)).T
        expected = xyz @ np.linalg.inv(colour.normalised_primary_matrix(spaces[1].primaries, (0.3127, 0.3290))).T
        assert (expected > 0.0).all()
        np.testing.assert_allclose(np.moveaxis(scene.basis, 0, -1)[::-1], expected, atol=3e-5)
    with pytest.raises(FileError, match=r"has the primaries DCI-P3; convert it"):
        list(FrameSource(tagged(tmp_path / "dci.mkv", picture, primaries=11), **LIGHT))


def test_colours_outside_srgb_are_clipped(tmp_path):
    pixels = np.array([[[0, 255, 0, 7], [255, 255, 255, 255]]], np.uint8)
    found = Colour(tmp_path, 13, 9).to_srgb(pixels)

    assert found.dtype == np.uint16
    assert found[0].tolist() == [[0, 65535, 0, 7 * 257], [65535, 65535, 65535, 65535]]
    assert Colour(tmp_path, 13, 1).to_srgb(pixels) is pixels
    grey = Colour(tmp_path, 1, 9).to_srgb(np.array([[0, 128, 255]], np.uint8))
    np.testing.assert_allclose(grey[0] / 65535, encode_srgb(bt709(np.array([0, 128, 255]) / 255)), atol=1e-3)
    assert Colour(tmp_path, 8, 1).to_srgb(np.full((1, 1, 2), 255, np.uint8)).tolist() == [[[65535, 65535]]]


def test_written_videos_specify_their_colours(tmp_path):
    sensor = fs.Sensor(fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0))
    light = fs.PowerMap(np.full((1, 40, 40), 0.1), fs.Grid.centred((40, 40), 1.0), np.array([550.0]))
    captures = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor).video(
        [light], exposure_s=1e-3, seed=0
    )
    write_video(captures, tmp_path / "v.mp4", max_pixels=32)
    with av.open(str(tmp_path / "v.mp4")) as container:
        codec = container.streams.video[0].codec_context
        found = [int(getattr(codec, name)) for name in ("colorspace", "color_range", "color_trc", "color_primaries")]
    assert found == [6, 1, 13, 1]


def test_unknown_matrices_and_formats_are_named(tmp_path):
    for matrix, name in ((8, "YCgCo"), (10, "BT.2020 with constant luminance"), (14, "ICtCp"), (99, "number 99")):
        frame = uniform_frame("yuv444p", [100, 128, 128])
        frame.colorspace = matrix
        with pytest.raises(FileError, match=f"has the colour matrix {name}"):
            pixels_of_frame(tmp_path, frame)
    for name in ("xyz12le", "gbrpf32le", "grayf32le", "bayer_rggb8"):
        with pytest.raises(FileError, match=f"has the pixel format {name}; convert it"):
            pixels_of_frame(tmp_path, av.VideoFrame(32, 16, name))


def test_alpha_multiplies_radiance(tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, (16, 32, 4), dtype=np.uint8)
    frame = av.VideoFrame.from_ndarray(picture, format="rgba")
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "bgra"
        container.mux(stream.encode(frame.reformat(format="bgra")))
        container.mux(stream.encode())
    (scene,) = FrameSource(tmp_path / "a.mkv", **LIGHT)

    np.testing.assert_array_equal(scene.basis, Scene.from_picture(picture, encoding="srgb", **LIGHT).basis)


# -- orientation and rejected properties ---------------------------------------------------------------------------------

#: Elements a, b, c, d of the display matrix: x' = a x + c y, y' = b x + d y, with y downwards; and the upright picture.
TURNS = {
    "none": ((1, 0, 0, 1), lambda p: p),
    "clockwise": ((0, 1, -1, 0), lambda p: np.rot90(p, -1)),
    "half": ((-1, 0, 0, -1), lambda p: np.rot90(p, 2)),
    "counterclockwise": ((0, -1, 1, 0), np.rot90),
    "mirrored": ((-1, 0, 0, 1), lambda p: p[:, ::-1]),
    "upside down": ((1, 0, 0, -1), lambda p: p[::-1]),
    "transposed": ((0, 1, 1, 0), lambda p: p.swapaxes(0, 1)),
    "transverse": ((0, -1, -1, 0), lambda p: p.swapaxes(0, 1)[::-1, ::-1]),
}


def with_matrix(path, content, elements):
    """Write a file with the matrix in its track header (version 0), as phones do."""
    at = content.index(b"tkhd") + 4 + 40
    a, b, c, d = (round(65536 * e) for e in elements)
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content[:at] + matrix + content[at + 36 :])
    return path


@pytest.mark.parametrize("turn", TURNS)
def test_display_matrix_is_applied(tmp_path, turn):
    picture = np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8)
    content = tagged(tmp_path / "a.mp4", picture, codec="libx264rgb").read_bytes()
    elements, upright = TURNS[turn]
    (pixels,) = VideoFile(with_matrix(tmp_path / "b.mp4", content, elements)).pixels()

    np.testing.assert_array_equal(pixels, upright(picture))


def test_other_display_matrices_are_named(tmp_path):
    content = tagged(tmp_path / "a.mp4", grey_ramp()).read_bytes()
    for elements in ((0.7, 0.7, -0.7, 0.7), (2, 0, 0, 2), (1, 0.5, 0, 1)):
        with pytest.raises(
            FileError,
            match=r"a display matrix other than turns by 90 degrees|pixels of the aspect ratio",
        ):
            list(VideoFile(with_matrix(tmp_path / "b.mp4", content, elements)).pixels())


def test_interlaced_videos_are_named(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        stream.options = {"x264-params": "interlaced=1"}
        for picture in [grey_ramp()[:, :64].repeat(4, axis=0)] * 3:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    with pytest.raises(
        FileError, match=r"a\.mkv: is interlaced; deinterlace it, for example with: ffmpeg -i IN -vf bwdif OUT"
    ):
        list(FrameSource(tmp_path / "a.mkv", **LIGHT))


def test_pixels_that_are_not_square_are_named(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(64, 45)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((32, 48, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    with pytest.raises(FileError, match=r"pixels of the aspect ratio 64:45; scale it to square ones"):
        FrameSource(tmp_path / "a.mp4", **LIGHT)


def test_files_with_several_videos_are_named(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 48, 32, "bgr0"
        for stream in streams:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((32, 48, 3), np.uint8), format="rgb24")))
            container.mux(stream.encode())
    with pytest.raises(FileError, match="contains 2 videos; extract one of them"):
        FrameSource(tmp_path / "a.mkv", **LIGHT)


def test_cover_art_is_not_a_video():
    from foveasim._io.videos.files import _is_cover

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=25)
        assert not _is_cover(stream)

        class Cover:
            disposition = type(stream.disposition).attached_pic | type(stream.disposition).default

        assert _is_cover(Cover)


@pytest.mark.parametrize("name", ["a.webp", "a.apng"])
def test_other_colour_profiles_are_named(tmp_path, name):
    from PIL import Image, ImageCms

    images = [Image.fromarray(np.full((32, 48, 3), v, np.uint8)) for v in (30, 90)]
    options = {"save_all": True, "append_images": images[1:], "duration": 100, "lossless": True}
    options |= {"format": "PNG" if name == "a.apng" else "WEBP"}
    for profile in ("sRGB", "LAB"):
        content = ImageCms.ImageCmsProfile(ImageCms.createProfile(profile)).tobytes()
        images[0].save(tmp_path / name, icc_profile=content, **options)
        footage = FrameSource(tmp_path / name, **LIGHT)
        assert footage.times_s.tolist() == pytest.approx([0.0, 0.1])
        if profile == "sRGB":
            assert len(list(footage)) == 2
        else:
            with pytest.raises(FileError, match=r"has the colour profile 'Lab.*'; convert it to sRGB, or specify"):
                list(footage)
            assert len(list(FrameSource(tmp_path / name, encoding="linear", **LIGHT))) == 2


def test_stereoscopic_and_spherical_frames_are_named(tmp_path):
    frame = uniform_frame("gray", [3])
    check_frame(tmp_path, frame, {"STEREO3D": bytes(12), "DISPLAYMATRIX": bytes(36)})
    with pytest.raises(FileError, match="is stereoscopic"):
        check_frame(tmp_path, frame, {"STEREO3D": bytes([1, 0, 0, 0, 0, 0, 0, 0])})
    with pytest.raises(FileError, match="is spherical"):
        check_frame(tmp_path, frame, {"SPHERICAL": bytes(40)})


def test_dolby_vision_needs_another_transfer(tmp_path):
    frame = uniform_frame("yuv420p10le", [300, 512, 512])
    for transfer, is_valid in ((2, False), (18, True)):
        decoded = Decoded(frame, Colour(tmp_path, transfer, 2), {"DOVI_METADATA": b""})
        if is_valid:
            assert frame_pixels(tmp_path, decoded).dtype == np.uint16
        else:
            with pytest.raises(FileError, match="is in Dolby Vision without another transfer"):
                frame_pixels(tmp_path, decoded)


def test_frames_without_matrix_are_unchanged(tmp_path):
    frame = uniform_frame("gray", [3])
    pixels = pixels_of_frame(tmp_path, frame)

    assert turned(tmp_path, pixels, None) is pixels
