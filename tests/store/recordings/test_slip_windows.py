"""Windows of features for training: which there are, and what they hold."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import SlipWindows

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
