"""Events from files of other programs: bytes by the published formats, with known pixels, times and polarities."""

from __future__ import annotations

import struct

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, ParameterError
from foveasim.modes import Events
from foveasim.modes._event_files import read_recording

h5py = pytest.importorskip("h5py")

#: Events of the sensor of 128 x 96 pixels: time in µs, x, y from the top, ON.
KNOWN = [(5000, 3, 2, True), (5000, 4, 2, True), (5007, 127, 95, False), (5100, 0, 0, True)]
HEADER = b"% camera_integrator_name Prophesee\n% date 2023-03-29 16:37:46\n"


def words(kind, *values):
    return struct.pack(f"<{len(values)}{kind}", *values)


def evt2(events, first_high=None):
    """Return EVT 2.0 words of events."""
    data, high = b"", first_high
    for t, x, y, on in events:
        if t >> 6 != high:
            high = t >> 6
            data += words("I", 8 << 28 | (high & 0xFFFFFFF))
        data += words("I", int(on) << 28 | (t & 63) << 22 | x << 11 | y)
    return data


def evt3(events):
    """Return EVT 3.0 words of events, each with a single address."""
    data, high = b"", None
    for t, x, y, on in events:
        if t >> 12 != high:
            high = t >> 12
            data += words("H", 8 << 12 | (high & 0xFFF))
        data += words("H", 6 << 12 | t & 0xFFF, y, 2 << 12 | int(on) << 11 | x)
    return data


RAW2 = HEADER + b"% evt 2.0\n% format EVT2;height=96;width=128\n% end\n"
RAW3 = HEADER + b"% evt 3.0\n% format EVT3;height=96;width=128\n% geometry 128x96\n% end\n"
DAT = b"% Data file containing CD events.\n% Version 2\n% Height 96\n% Width 128\n\x0c\x08"


def dat(events):
    return b"".join(words("I", t & 0xFFFFFFFF, x | y << 14 | int(on) << 28) for t, x, y, on in events)


def evt21(events, mask=1, *, legacy=False):
    data = b""
    for t, x, y, on in events:
        for cd, valid in ((8 << 28 | t >> 6, 0), (int(on) << 28 | (t & 63) << 22 | x << 11 | y, mask)):
            data += words("I", cd, valid) if legacy else words("I", valid, cd)
    return data


RAW21 = HEADER + b"% evt 2.1\n% format EVT21;height=96;width=128;endianness="
FILES = {
    "known2.raw": RAW2 + evt2(KNOWN),
    "known3.raw": RAW3 + evt3(KNOWN),
    "known21.raw": RAW21 + b"little\n% end\n" + evt21(KNOWN),
    "legacy21.raw": RAW21 + b"legacy\n% end\n" + evt21(KNOWN, legacy=True),
    "known.dat": DAT + dat(KNOWN),
}


def rows(events):
    """Return time in µs, x, y from the top and polarity of events on a grid."""
    x, y = events.addresses()
    t_us = np.rint(events.t_s * 1e6).astype(int)
    return list(
        zip(
            t_us.tolist(), x[events.site].tolist(), y[events.site].tolist(), (events.polarity > 0).tolist(), strict=True
        )
    )


def read(tmp_path, data, name="events.raw", layout=None, **options):
    path = tmp_path / name
    path.write_bytes(data)
    return Events.read(path, layout, **({"pitch_um": 5.0} if layout is None else {}) | options)


@pytest.mark.parametrize("name", list(FILES))
def test_files_contain_known_events(tmp_path, name):
    events = read(tmp_path, FILES[name], name)

    assert rows(events) == KNOWN
    assert events.layout.n_sites == 128 * 96
    # Row 0 is the top row of the picture, the highest y.
    top_left = events.layout.centroid_um[events.site[-1]]
    assert top_left == pytest.approx([-0.5 * 127 * 5.0, 0.5 * 95 * 5.0])


def test_events_are_placed_on_given_layout(tmp_path):
    layout = fs.layout.grid(n_x=128, n_y=96, pitch_um=4.86)
    events = read(tmp_path, FILES["known3.raw"], layout=layout)

    assert events.layout is layout
    assert rows(events) == KNOWN
    with pytest.raises(
        ParameterError, match=r"'layout' must have one site at each address \(x, y\), got 0 at \(127, 95\)"
    ):
        read(tmp_path, FILES["known3.raw"], layout=fs.layout.grid(n_x=64, n_y=48, pitch_um=5.0))
    with pytest.raises(
        ParameterError, match=r"'layout' must be given for events.raw: the sensor has 128 x 96 pixels; or"
    ):
        read(tmp_path, FILES["known3.raw"], pitch_um=None)
    without = HEADER + b"% evt 3.0\n" + evt3(KNOWN)
    with pytest.raises(ParameterError, match="the file does not state the size of the sensor"):
        read(tmp_path, without)
    assert rows(read(tmp_path, without, layout=layout)) == KNOWN


def test_vectors_have_one_event_for_each_bit(tmp_path):
    data = words(
        "H",
        8 << 12 | 1,
        6 << 12 | 7,
        90,
        3 << 12 | 1 << 11 | 40,
        4 << 12 | 0b1000_0000_0001,
        4 << 12,
        5 << 12 | 0b1000_0001,
    )
    data += words("H", 2 << 12 | 9)  # a single OFF event does not move the base
    expected = [(4103, x, 90, True) for x in (40, 51, 64, 71)] + [(4103, 9, 90, False)]

    assert rows(read(tmp_path, RAW3 + data)) == expected
    mask = read(tmp_path, RAW21 + b"little\n" + evt21([(70, 64, 5, True)], mask=1 << 31 | 1))
    assert rows(mask) == [(70, 64, 5, True), (70, 95, 5, True)]


@pytest.mark.parametrize(
    ("header", "write", "loop_us"), [(RAW2, evt2, 1 << 34), (RAW3, evt3, 1 << 24), (DAT, dat, 1 << 32)]
)
def test_times_continue_when_bits_overflow(tmp_path, header, write, loop_us):
    known = [
        (loop_us - 10, 1, 1, True),
        (loop_us + 5, 2, 2, False),
        (2 * loop_us - 3, 3, 3, True),
        (2 * loop_us, 4, 4, True),
    ]
    name = "events.dat" if header is DAT else "events.raw"

    assert rows(read(tmp_path, header + write(known), name)) == known


def test_low_bits_may_begin_anew_alone(tmp_path):
    # expelliarmus writes the high bits once.
    data = words("H", 8 << 12 | 1, 6 << 12 | 4000, 7, 2 << 12 | 1, 6 << 12 | 10, 2 << 12 | 2)

    assert [row[0] for row in rows(read(tmp_path, RAW3 + data))] == [4096 + 4000, 8192 + 10]


def test_other_words_are_no_events(tmp_path):
    trigger = words("H", 0xA << 12 | 1, 0xE << 12 | 0x16, 0xF << 12 | 5, 7 << 12 | 3)
    before = words("H", 5, 2 << 12 | 9)
    assert rows(read(tmp_path, RAW3 + before + trigger + evt3(KNOWN) + trigger)) == KNOWN
    trigger = words("I", 0xA << 28 | 1, 0xE << 28, 0xF << 28)
    before = words("I", 1 << 28 | 5 << 22 | 9 << 11)
    assert rows(read(tmp_path, RAW2 + before + trigger + evt2(KNOWN) + trigger)) == KNOWN


def test_origin_may_be_first_event(tmp_path):
    events = read(tmp_path, FILES["known2.raw"], origin="first_event")

    assert rows(events) == [(t - 5000, *rest) for t, *rest in KNOWN]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (RAW3 + evt3(KNOWN) + words("H", 0x9 << 12), r"a word of an unknown type at byte \d+"),
        (RAW2 + evt2(KNOWN) + words("I", 0x5 << 28), r"a word of an unknown type at byte \d+"),
        (RAW3 + evt3(KNOWN) + words("H", 8 << 12), r"a time that falls at byte \d+"),
        (RAW3 + evt3(KNOWN)[:-1], r"is truncated: \d+ bytes of data are no multiple of the 2 bytes of a word"),
        (RAW2 + evt2(KNOWN)[:-1], "is truncated"),
        (RAW3 + evt3([(5000, 130, 2, True)]), r"an event with x = 130, outside the sensor: 0 to 127"),
        (HEADER + b"% evt 4.0\n", "states evt 4.0, must be EVT2, EVT21 or EVT3"),
        (HEADER + b"% end\n", "states no encoding"),
        (HEADER + b"% evt 2.0\n% format EVT3\n", "states EVT3 and evt 2.0, which are different"),
        (HEADER + b"% format HISTO3D;height=320;width=320\n", "states HISTO3D"),
        (HEADER + b"% format EVT3;binning=2\n", "has the option 'binning=2' of its format, which is not known"),
        (HEADER + b"% format EVT3;endianness=big\n", "states the endianness big, must be little"),
        (HEADER + b"% format EVT21;height=96;width=128\n", "must state the endianness of EVT 2.1"),
        (HEADER + b"% format EVT3;height=96;width=128\n% geometry 64x48\n", "states different sizes of the sensor"),
        (HEADER + b"% format EVT3;height=x;width=1280\n", "must be two numbers"),
        (
            HEADER + b"% evt 3.0\n% region_of_interest 0 0 640 480\n",
            r"has the header 'region_of_interest', which is not known",
        ),
        (b"% evt 3.0" + b"x" * 70_000, "has a header of more than"),
    ],
)
def test_damaged_raw_files_are_named(tmp_path, data, message):
    with pytest.raises(FileError, match=message):
        read(tmp_path, data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (DAT + dat(KNOWN)[:-3], "is truncated"),
        (DAT[:-2] + b"\x28\x08" + dat(KNOWN), r"must contain CD events of 8 bytes \(type 12\), got \[40, 8\]"),
        (DAT[:-2], "must contain CD events"),
        (DAT.replace(b"Version 2", b"Version 1") + dat(KNOWN), "is a DAT file of version 1, must be 2"),
        (DAT + words("I", 5, 3 << 28), "has the polarity 3"),
        (DAT.replace(b"Version", b"Mirror x\n% Version"), "has the header 'mirror', which is not known"),
    ],
)
def test_damaged_dat_files_are_named(tmp_path, data, message):
    with pytest.raises(FileError, match=message):
        read(tmp_path, data, "events.dat")


def test_unknown_headers_may_be_ignored(tmp_path):
    data = RAW3.replace(b"% end", b"% weather sunny\n% end") + evt3(KNOWN)

    assert rows(read(tmp_path, data, ignore=("weather",))) == KNOWN


# -- AEDAT -------------------------------------------------------------------------------------------------------------


def aedat2(events, *, shape=(260, 346), chip="eu.seebetter.ini.chips.davis.Davis346blue", shifts=(22, 12, 11)):
    """Return AEDAT 2 of jAER: x from the right, y from the bottom, big-endian."""
    head = b"#!AER-DAT2.0\r\n# Data format is int32 address, int32 timestamp\r\n"
    head += f"# AEChip: {chip}\r\n".encode() if chip else b""
    y_at, x_at, on_at = shifts
    return head + b"".join(
        struct.pack(">II", (shape[0] - 1 - y) << y_at | (shape[1] - 1 - x) << x_at | int(on) << on_at, t)
        for t, x, y, on in events
    )


def test_aedat2_has_addresses_of_jaer(tmp_path):
    known = [(10, 0, 0, True), (12, 345, 259, False), (700, 20, 100, True)]
    samples = struct.pack(">II", 1 << 31 | 5 << 12, 11) + struct.pack(">II", 1 << 10, 11)
    assert rows(read(tmp_path, aedat2(known) + samples + aedat2([], chip="")[:0], "e.aedat")) == known
    # v2e does not name the chip.
    layout = fs.layout.grid(n_x=640, n_y=480, pitch_um=5.0)
    known = [(10, 0, 0, True), (12, 639, 479, False)]
    data = aedat2(known, shape=(480, 640), chip="", shifts=(11, 1, 0))
    assert rows(read(tmp_path, data, "e.aedat2", layout)) == known
    for wrong, message in (
        (
            aedat2([], chip="ch.unizh.ini.jaer.chip.retina.DVS128"),
            "is of the chip DVS128, whose addresses are not known",
        ),
        (data, "does not name its chip, and must be of a sensor of 346 x 260, .*; pass a layout of its size"),
        (b"#!AER-DAT3.1\r\n", "is of the version AER-DAT3.1, must be AER-DAT2.0 or AER-DAT4.0"),
        (aedat2(KNOWN[:1])[:-1], "is truncated"),
    ):
        with pytest.raises(FileError, match=message):
            read(tmp_path, wrong, "e.aedat")


# -- arrays and text ---------------------------------------------------------------------------------------------------


def arrays(**changes):
    t, x, y, p = (np.array(values) for values in zip(*KNOWN, strict=True))
    return {
        "t": t.astype(np.int64),
        "x": x.astype(np.uint16),
        "y": y.astype(np.uint16),
        "p": p.astype(np.uint8),
    } | changes


def write_hdf5(path, kind, found, **others):
    with h5py.File(path, "w") as file:
        if kind == "dsec":
            for name, values in found.items():
                file[f"events/{name}"] = values
            file["ms_to_idx"] = np.zeros(7, np.uint64)
        elif kind == "v2e":
            file["events"] = np.stack(list(found.values()), axis=1).astype(np.uint32)
        else:
            records = np.zeros(len(found["t"]), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
            for name, values in found.items():
                records[name] = values
            file["CD/events"] = records
            file["CD/indexes"] = np.zeros(3)
            file.attrs["geometry"] = "128x96"
        for name, value in others.items():
            file[name] = value


@pytest.mark.parametrize("kind", ["dsec", "v2e", "metavision"])
def test_hdf5_of_other_programs_is_read(tmp_path, kind):
    path = tmp_path / "events.h5"
    layout = None if kind == "metavision" else fs.layout.grid(n_x=128, n_y=96, pitch_um=5.0)
    pitch = {"pitch_um": 5.0} if layout is None else {}
    write_hdf5(path, kind, arrays(), **({"t_offset": 2_000_000} if kind == "dsec" else {}))

    offset_us = 2_000_000 if kind == "dsec" else 0
    assert rows(Events.read(path, layout, **pitch)) == [(t + offset_us, *rest) for t, *rest in KNOWN]
    # Polarities of -1 and 1.
    write_hdf5(path, "dsec", arrays(p=2 * arrays()["p"].astype(np.int8) - 1))
    assert rows(Events.read(path, fs.layout.grid(n_x=128, n_y=96, pitch_um=5.0))) == KNOWN


def test_damaged_hdf5_files_are_named(tmp_path):
    layout, path = fs.layout.grid(n_x=128, n_y=96, pitch_um=5.0), tmp_path / "events.h5"
    cases = [
        ({"p": np.array([0, 1, 2, 1])}, "has the polarity 2, must have 0 and 1, or -1 and 1"),
        ({"p": np.array([0, 1, -1, 1])}, "has polarities of 0 and of -1"),
        ({"x": np.array([0.5, 1.0, 2.0, 3.0])}, "must have integers as x"),
        ({"t": np.array([5, 6, 7])}, "must have a time, x, y and a polarity for each event"),
        ({"t": np.array([-5, 6, 7, 8])}, "must have times from 0"),
        ({"scale": np.ones(4)}, "has 'events/scale', which is not known; pass ignore="),
    ]
    for changes, message in cases:
        write_hdf5(path, "dsec", arrays(**changes))
        with pytest.raises(FileError, match=message):
            Events.read(path, layout)
    assert len(Events.read(path, layout, ignore=("scale",))) == 4
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = np.zeros((3, 4))
    with pytest.raises(
        FileError, match="must have 'events' as of DSEC or v2e, or 'CD/events' as of Metavision, got davis"
    ):
        Events.read(path, layout)


def test_unsorted_events_are_sorted_by_time(tmp_path):
    path = tmp_path / "events.h5"
    write_hdf5(path, "dsec", {name: values[::-1] for name, values in arrays().items()})

    found = rows(Events.read(path, fs.layout.grid(n_x=128, n_y=96, pitch_um=5.0)))
    assert sorted(found) == sorted(KNOWN)
    assert [row[0] for row in found] == [row[0] for row in KNOWN]


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".npy", ".txt"])
def test_own_files_are_read(tmp_path, suffix):
    layout = fs.layout.grid(n_x=6, n_y=4, pitch_um=4.0)
    events = Events(np.array([1e-5, 2e-5, 3e-5]), np.array([0, 23, 7]), np.array([1, -1, 1], np.int8), layout)
    path = tmp_path / f"events{suffix}"
    events.save(path)
    own = suffix in {".npz", ".h5"}
    empty = tmp_path / f"empty{suffix}"
    events.between(1.0, 2.0).save(empty)
    assert len(Events.read(empty, None if own else layout)) == 0
    found = Events.read(path, None if own else layout)

    assert np.allclose(found.t_s, events.t_s, atol=1e-9)
    assert np.array_equal(found.site, events.site)
    assert np.array_equal(found.polarity, events.polarity)
    if own:
        with pytest.raises(ParameterError, match="'layout' must not be given for files with their layout"):
            Events.read(path, layout)


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        ("# t x y p\n0.005 1 0 1\n0.006 0 1 0\n", {}, [(5000, 1, 0, True), (6000, 0, 1, False)]),
        ("0.005,1,0,1\n0.006,0,1,-1\n", {}, [(5000, 1, 0, True), (6000, 0, 1, False)]),
        ("5000 1 0 1\n", {"time_unit": "us"}, [(5000, 1, 0, True)]),
        ("5000500 1 0 1\n", {"time_unit": "ns"}, [(5000, 1, 0, True)]),
        ("5 1 0 1\n", {"time_unit": "ms"}, [(5000, 1, 0, True)]),
    ],
)
def test_text_has_times_with_unit(tmp_path, text, options, expected):
    layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=5.0)

    assert rows(read(tmp_path, text.encode(), "events.txt", layout, **options)) == expected


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (b"5000 1 0 1\n", {}, "has integers as times, of unknown unit; pass time_unit='us'"),
        (b"0.1 1 0 1\n0.2 1 0\n", {}, "is corrupt or not a valid file of events"),
        (b"0.1 1 0 1\n0.2 1.5 0 1\n", {}, "must have integers as x"),
        (b"0.1 1 0 1\n0.2 1 nan 1\n", {}, "must have finite numbers"),
        (b"hello\n", {}, "is not a valid file of events: expected AEDAT 2, AEDAT 4, HDF5"),
    ],
)
def test_damaged_text_is_named(tmp_path, data, options, message):
    with pytest.raises(FileError, match=message):
        read(tmp_path, data, "events.txt", fs.layout.grid(n_x=2, n_y=2, pitch_um=5.0), **options)


def test_options_of_other_formats_are_rejected(tmp_path):
    with pytest.raises(ParameterError, match=r"'time_unit' is not an option of Prophesee RAW"):
        read(tmp_path, FILES["known3.raw"], time_unit="us")
    with pytest.raises(ParameterError, match="'time_unit' must be one of"):
        read(tmp_path, b"0.1 1 0 1\n", "events.txt", time_unit="minutes")
    with pytest.raises(ParameterError, match="'origin' must be one of"):
        read(tmp_path, FILES["known3.raw"], origin="now")
    with pytest.raises(FileError, match="no such file"):
        Events.read(tmp_path / "missing.raw")


def test_numpy_arrays_need_fields(tmp_path):
    layout, path = fs.layout.grid(n_x=128, n_y=96, pitch_um=5.0), tmp_path / "events.npy"
    for values, message in (
        (
            np.zeros((3, 4)),
            r"must be a structured array with the fields t, x, y and p, got float64 of the shape \(3, 4\)",
        ),
        (
            np.zeros(3, [("t", "f8"), ("x", "i2"), ("y", "i2"), ("p", "?")]),
            "has decimal numbers as times, of unknown unit",
        ),
    ):
        np.save(path, values)
        with pytest.raises(FileError, match=message):
            Events.read(path, layout)
    assert len(Events.read(path, layout, time_unit="s")) == 3


# -- mutations ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FILES, "events.aedat", "events.txt", "events.npy"])
def test_mutated_files_are_valid_or_named(tmp_path, name):
    path = tmp_path / name
    if name == "events.npy":
        Events.read(_written(tmp_path, "known3.raw"), pitch_um=5.0).save(path)
        data = path.read_bytes()
    else:
        lines = b"".join(b"%.6f %d %d %d\n" % (t / 1e6, x, y, on) for t, x, y, on in KNOWN)
        data = FILES.get(name) or {"events.aedat": aedat2(KNOWN[:1]), "events.txt": lines}[name]
    rng = np.random.default_rng(1)
    for _ in range(1000):
        changed = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            changed[rng.integers(len(changed))] = rng.integers(256)
        path.write_bytes(bytes(changed[: rng.integers(1, len(changed) + 1)] if rng.random() < 0.3 else changed))
        try:
            read_recording(path)
        except (FileError, ParameterError) as error:
            assert "\n" not in str(error)  # noqa: PT017 -- one line


def _written(tmp_path, name):
    path = tmp_path / f"source_{name}"
    path.write_bytes(FILES[name])
    return path
