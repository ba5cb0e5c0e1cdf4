"""Windows of features for training: which there are, what they hold, and in bounded memory."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings import slip_windows
from evetac_cli.store.recordings.slip_windows import SlipWindows

LABEL = [0] * 20 + [1] * 6 + [-1] * 4


def write_features(path: Path, label: list[int] | None = None, onset: int = -1) -> tuple[Path, dict[str, Any]]:
    """Features of 6 dots whose numbers are all different."""
    slices = len(label or LABEL)
    numbers = np.arange(slices * 6).reshape(slices, 6)
    arrays: dict[str, Any] = {
        "displacement_px": numbers.astype(np.float32),
        "events_per_dot": (numbers + 10_000).astype(np.int32),
        "events_total": np.zeros(slices, np.int32),
        "events_outside": np.zeros(slices, np.int32),
        "dot_shape": np.array([2, 3], np.int32),
    }
    if label is not None:
        arrays |= {"label": np.array(label, np.int8), "onset_slice": np.int64(onset)}
    write_stage(path, Recipe("features", 1, {}), arrays)
    return path, arrays


@pytest.mark.parametrize(
    ("label", "onset", "history", "after", "slices"),
    [
        (LABEL, 20, 10, 15, [*range(9, 26)]),  # the examined ones, from where the history is full
        (LABEL, 20, 10, 3, [*range(9, 23)]),
        (LABEL, 20, 26, 15, [25]),
        (LABEL, 20, 27, 15, []),
        ([0] * 12, -1, 10, 15, [9, 10, 11]),
        ([0, -1, 0, -1, 0], -1, 2, 15, [2, 4]),
    ],
)
def test_windows_are_cut_where_they_can_be_learned_from(
    tmp_path: Path, label: list[int], onset: int, history: int, after: int, slices: list[int]
) -> None:
    """Assert that items are the slices with a label, a full history and not long after the onset, newest first."""
    path, arrays = write_features(tmp_path / "a.features.h5", label, onset)
    data = SlipWindows([path], history, after)
    assert len(data) == len(slices)
    for index, slice_ in enumerate(slices):
        window, wanted = data[index]
        assert window.dtype == np.float32
        assert wanted.dtype == np.float32
        assert wanted == label[slice_]
        back = slice_ - np.arange(history)
        np.testing.assert_array_equal(window[:, :history], arrays["displacement_px"][back].T)
        np.testing.assert_array_equal(window[:, history:], arrays["events_per_dot"][back].T)


def test_windows_of_several_files(tmp_path: Path) -> None:
    """Assert that files follow each other, and no window reaches from one into another."""
    first, _ = write_features(tmp_path / "a.features.h5", [0] * 11)
    second, arrays = write_features(tmp_path / "b.features.h5", [0] * 5 + [1] * 8, 5)
    data = SlipWindows([str(first), second], history=10)
    assert [float(data[index][1]) for index in range(len(data))] == [0, 0, 1, 1, 1, 1]
    np.testing.assert_array_equal(data[2][0][:, 9], arrays["displacement_px"][0])
    assert len(SlipWindows([])) == 0


def test_windows_need_labels(tmp_path: Path) -> None:
    """Assert that features without labels are refused, with what to do."""
    path, _ = write_features(tmp_path / "a.features.h5")
    with pytest.raises(InputError, match=r"(?s)have no labels.*evetac label"):
        SlipWindows([path])


def test_windows_are_the_same_in_a_worker(tmp_path: Path) -> None:
    """Assert that windows travel to another process as the names of their files."""
    path, _ = write_features(tmp_path / "a.features.h5", [0] * 5 + [1] * 8, 5)
    data = SlipWindows([path], 3, 4)
    state = pickle.dumps(data)
    assert len(state) < 1000
    copy = pickle.loads(state)
    assert len(copy) == len(data) == 7
    for one, other in zip([data[index] for index in range(7)], [copy[index] for index in range(7)], strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1] == other[1]


class Opened(StageFile):
    """A stage file that notes that it was opened."""

    noted: list[str] = []

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(path, kind)
        self.noted.append(self.path.name)


@pytest.fixture
def many(tmp_path: Path) -> list[Path]:
    """Five files of 40 slices, of which 26 end a window of 10; they take 1,680 bytes each."""
    return [write_features(tmp_path / f"{name}.features.h5", [0] * 20 + [1] * 20, 20)[0] for name in "abcde"]


@pytest.mark.parametrize("memory_gb", [1.0, 4e-6, 1e-9])
def test_windows_are_the_same_in_any_memory(many: list[Path], memory_gb: float) -> None:
    """Assert that windows do not depend on how many files fit into memory, in whatever order they are asked for."""
    whole, some = SlipWindows(many), SlipWindows(many, memory_gb=memory_gb)
    order = np.random.default_rng(0).permutation(len(whole)).tolist()
    assert len(some) == len(whole) == 5 * 26
    for index in order:
        np.testing.assert_array_equal(whole[index][0], some[index][0])
        assert whole[index][1] == some[index][1]


@pytest.mark.parametrize(("memory_gb", "at_once"), [(1.0, 5), (4e-6, 2), (1e-9, 1)])
def test_shuffled_windows_read_each_file_once(
    many: list[Path], monkeypatch: pytest.MonkeyPatch, memory_gb: float, at_once: int
) -> None:
    """Assert that an epoch has every window once, no two epochs the same order, and never more files in memory."""
    monkeypatch.setattr(slip_windows, "StageFile", Opened)
    windows = SlipWindows(many, memory_gb=memory_gb)
    order, epochs = windows.shuffled(seed=3), []
    assert len(order) == len(windows)
    for _ in range(2):
        Opened.noted.clear()
        epochs.append([])
        for index in order:
            windows[index]
            epochs[-1].append(index)
            assert len(windows._cache) <= at_once
        assert sorted(epochs[-1]) == list(range(len(windows)))
        assert len(Opened.noted) == len(set(Opened.noted)) <= (0 if at_once == 5 else 5)
    assert epochs[0] != epochs[1]
    assert list(windows.shuffled(seed=3)) == epochs[0]
    assert (len({index // 26 for index in epochs[0][:26]}) > 1) == (at_once > 1)
