"""Events of other programs: files that they write, and what they read."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

from foveasim.modes._event_files import read_recording

ARRAY = np.dtype([("t", np.int64), ("x", np.int16), ("y", np.int16), ("p", np.uint8)])


def known_events(n=20_000):
    rng = np.random.default_rng(0)
    events = np.zeros(n, ARRAY)
    events["t"] = 5000 + np.cumsum(rng.integers(0, 9, n))
    events["x"], events["y"] = rng.integers(0, 640, n), rng.integers(0, 480, n)
    events["p"] = rng.integers(0, 2, n)
    return events


def assert_equal(found, events):
    assert len(found.t_us) == len(events["t"])
    assert np.array_equal(found.t_us, events["t"])
    assert np.array_equal(found.x, events["x"])
    assert np.array_equal(found.y, events["y"])
    assert np.array_equal(found.is_on, events["p"].astype(int) == 1)


@pytest.mark.parametrize(("encoding", "name"), [("dat", "e.dat"), ("evt2", "e.raw"), ("evt3", "e.raw")])
def test_files_of_expelliarmus_are_equal(tmp_path, encoding, name):
    expelliarmus = other_program("expelliarmus")
    path, events = tmp_path / name, known_events()
    wizard = expelliarmus.Wizard(encoding=encoding)
    wizard.save(fpath=str(path), arr=events)

    assert_equal(read_recording(path), events)
    assert_equal(read_recording(path), wizard.read(str(path)))


@pytest.mark.parametrize(("encoding", "name"), [("evt2", "e.raw"), ("evt3", "e.raw")])
def test_evlib_reads_the_same_events(tmp_path, encoding, name):
    evlib = other_program("evlib")
    path = tmp_path / name
    events = known_events()
    write_evt(path, encoding, events)
    table = evlib.load_events(str(path)).collect()
    found = read_recording(path)

    assert_equal(found, events)
    assert np.array_equal(found.t_us, table["t"].dt.total_microseconds().to_numpy())
    assert np.array_equal(found.x, table["x"].to_numpy())
    assert np.array_equal(found.y, table["y"].to_numpy())
    assert np.array_equal(found.is_on, table["polarity"].to_numpy() == 1)


def write_evt(path, encoding, events):
    """Write each event with its own time words."""
    t, x, y, p = (events[name].astype(np.int64) for name in "txyp")
    if encoding == "evt3":
        words = np.stack((8 << 12 | t >> 12 & 0xFFF, 6 << 12 | t & 0xFFF, y, 2 << 12 | p << 11 | x), axis=1).astype(
            "<u2"
        )
        header = b"% evt 3.0\n% format EVT3;height=480;width=640\n% geometry 640x480\n% end\n"
    else:
        words = np.stack((8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y), axis=1).astype("<u4")
        header = b"% evt 2.0\n% format EVT2;height=480;width=640\n% geometry 640x480\n% end\n"
    path.write_bytes(header + words.tobytes())


@pytest.mark.parametrize(("encoding", "name"), [("evt3", "e.raw"), ("dat", "e.dat"), ("aedat4", "e.aedat4")])
def test_aestream_reads_the_same_events(tmp_path, encoding, name):
    aestream = other_program("aestream")
    path, events = tmp_path / name, known_events(2000)
    if encoding == "aedat4":
        write_aedat4(path, events)
    elif encoding == "dat":
        other_program("expelliarmus").Wizard(encoding=encoding).save(fpath=str(path), arr=events)
    else:
        write_evt(path, encoding, events)
    other = aestream.FileInput(str(path), (640, 480)).load()
    found = read_recording(path)

    assert_equal(found, events)
    assert len(other) == len(events)
    if encoding != "evt3":  # its times of EVT 3.0 are not those of the words
        assert np.array_equal(found.t_us, other["timestamp"])
    assert np.array_equal(found.x, other["x"])
    assert np.array_equal(found.y, other["y"])


def write_aedat4(path, events):
    dv = other_program("dv_processing")
    store = dv.EventStore()
    for t, x, y, p in events.tolist():
        store.push_back(t, x, y, bool(p))
    writer = dv.io.MonoCameraWriter(str(path), dv.io.MonoCameraWriter.EventOnlyConfig("camera", (640, 480)))
    writer.writeEvents(store)
    del writer


def test_aedat4_of_dv_processing_is_equal(tmp_path):
    other_program("aedat")
    path, events = tmp_path / "e.aedat4", known_events(5000)
    write_aedat4(path, events)
    found = read_recording(path)

    assert_equal(found, events)
    assert found.shape == (480, 640)


def test_damaged_aedat4_is_valid_or_named(tmp_path):
    other_program("aedat")
    from foveasim.errors import FileError

    path = tmp_path / "e.aedat4"
    write_aedat4(path, known_events(500))
    data, rng = path.read_bytes(), np.random.default_rng(3)
    for _ in range(30):
        changed = bytearray(data)
        for _ in range(3):
            changed[rng.integers(14, len(changed))] = rng.integers(256)
        path.write_bytes(bytes(changed))
        try:
            read_recording(path)
        except FileError as error:
            assert "\n" not in str(error)  # noqa: PT017 -- one line
