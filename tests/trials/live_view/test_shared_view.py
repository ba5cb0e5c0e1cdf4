"""What a live view reads is what the loop wrote, or is left out."""

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.trials.live_view.shared_view import EVENTS, SLICES, GripperNumbers, SharedView


def slice_of(size: int, rng: np.random.Generator) -> Events:
    x, y, p = (rng.integers(0, most, size) for most in (640, 480, 2))
    return Events(np.zeros(size, np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def same(view: SharedView, first: int, wrote: list[Events]) -> bool:
    """Whether the slices since `first` are those that were written."""
    seen = view.since(first)
    assert seen.first + seen.slices == len(wrote)
    for k, events in enumerate(wrote[seen.first :]):
        part = slice(seen.starts[k], seen.starts[k + 1])
        for column, expected in zip((seen.x, seen.y, seen.p), events[1:], strict=True):
            np.testing.assert_array_equal(column[part], expected)
    return seen.first == first


def test_slices_come_as_they_were_written() -> None:
    """Assert that slices of any size, empty ones too, are read as written, from any number on."""
    rng, view, wrote = np.random.default_rng(0), SharedView(), []
    assert view.since(0).slices == 0
    for size in (3, 0, 0, 700, 1):
        wrote.append(slice_of(size, rng))
        view.add_slice(wrote[-1], late_us=10.0 * size, probability=size / 1000)
        assert all(same(view, first, wrote) for first in range(len(wrote) + 1))
    seen = view.since(3)
    assert seen.late_us.tolist() == [7000.0, 10.0]
    np.testing.assert_allclose(seen.probability, [0.7, 0.001], rtol=1e-6)


def test_what_is_written_over_is_left_out() -> None:
    """Assert that a reader gets the newest slices whole, and none of which events were written over."""
    rng, view, wrote = np.random.default_rng(1), SharedView(), []
    several = [slice_of(200_000, rng) for _ in range(3)]
    for k in range(EVENTS // 200_000 + 5):
        wrote.append(several[k % 3])
        view.add_slice(wrote[-1])
    assert same(view, len(wrote) - 1, wrote)
    assert not same(view, 0, wrote)


def test_more_slices_than_there_is_room_for() -> None:
    """Assert that an old slice is not taken for a new one of the same place."""
    view, empty = SharedView(), slice_of(0, np.random.default_rng(0))
    for _ in range(SLICES + 5):
        view.add_slice(empty)
    seen = view.since(0)
    assert seen.first + seen.slices == SLICES + 5
    assert seen.first > 5
    assert not seen.starts.any()


def test_a_reader_is_overtaken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what is written over between two steps of a reader is left out as well."""
    rng, view = np.random.default_rng(3), SharedView()
    for _ in range(5):
        view.add_slice(slice_of(100_000, rng))
    kept, asked = view._kept, []

    def overtaken(bounds: np.ndarray) -> int:
        asked.append(kept(bounds))
        if len(asked) == 1:
            for _ in range(EVENTS // 100_000):
                view.add_slice(slice_of(100_000, rng))
        return asked[-1]

    monkeypatch.setattr(view, "_kept", overtaken)
    seen = view.since(0)
    assert asked == [0, 5]
    assert (seen.first, seen.slices, len(seen.x)) == (5, 0, 0)


def test_gripper_and_button() -> None:
    """Assert that the latest command is read, and that the button is not pressed before somebody presses it."""
    view = SharedView()
    assert view.gripper is None
    view.set_gripper(GripperNumbers(400, 402, 20.0, float("nan"), 0, 1))
    assert view.gripper is not None
    assert view.gripper[:3] == (400, 402, 20.0)
    assert not view.is_asked_to_let_go
    view.let_go()
    assert view.is_asked_to_let_go
