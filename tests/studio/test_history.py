"""Undo and redo of settings."""

from __future__ import annotations

from foveasim.studio._history import History


def test_hundred_steps_are_undone_and_repeated():
    history = History({"n": 0})
    for n in range(1, 101):
        history.commit({"n": n})

    back = [history.settings["n"] for _ in range(100) if history.undo()]
    forth = [history.settings["n"] for _ in range(100) if history.redo()]

    assert back == list(range(99, -1, -1))
    assert forth == list(range(1, 101))
    assert not history.redo()


def test_step_after_undo_discards_later_states():
    history = History({"n": 0})
    history.commit({"n": 1})
    history.undo()
    history.commit({"n": 2})

    assert not history.can_redo
    assert history.undo()
    assert history.settings == {"n": 0}


def test_previews_add_no_steps():
    history = History({"n": 0})
    for n in (1, 2, 3):
        history.preview({"n": n})
    history.commit({"n": 4})

    assert history.settings == {"n": 4}
    assert history.undo()
    assert history.settings == {"n": 0}
    assert not history.can_undo


def test_equal_settings_add_no_step():
    history = History({"n": 0})
    history.commit({"n": 0})

    assert not history.can_undo


def test_copies_are_independent():
    history = History({"n": 0})
    history.commit({"n": 1})
    copied = history.copy()
    history.undo()

    assert copied.settings == {"n": 1}
    assert copied.can_undo
    assert not copied.can_redo


def test_states_share_equal_sections():
    history = History({"scene": {"kind": "flat"}, "seed": 1})
    first = history.settings
    history.commit({"scene": {"kind": "flat"}, "seed": 2})

    assert history.settings == {"scene": {"kind": "flat"}, "seed": 2}
    assert history.settings["scene"] is first["scene"]
    assert history.undo()
    assert history.settings == {"scene": {"kind": "flat"}, "seed": 1}
