"""The command that reads events of event cameras."""

from __future__ import annotations

import numpy as np

import foveasim as fs


def test_events_are_read_and_written(foveasim, tmp_path):
    (tmp_path / "events.raw").write_bytes(
        b"% evt 3.0\n% format EVT3;height=4;width=6\n% end\n"
        + np.array([8 << 12, 6 << 12 | 9, 1, 2 << 12 | 1 << 11 | 5, 2 << 12 | 3], "<u2").tobytes()
    )
    result = foveasim("events", "events.raw", "--pitch-um", "5", "--out", "events.npz", cwd=tmp_path)

    assert result.returncode == 0
    assert result.stdout.splitlines() == [
        "2 events of 24 photosites, 1 of them ON, from 0.000009 to 0.000009 s",
        "wrote events.npz",
    ]
    events = fs.modes.Events.load(tmp_path / "events.npz")
    assert events.polarity.tolist() == [1, -1]
    assert events.site.tolist() == [17, 15]  # row 1 from the top is row 2
    result = foveasim("events", "events.raw", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith(
        "error: 'layout' must be given for events.raw: the sensor has 6 x 4 pixels; or pass"
    )
