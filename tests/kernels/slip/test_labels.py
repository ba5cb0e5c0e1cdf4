"""Labels shifted ahead of time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.kernels.slip.labels import shift_labels


def test_labels_shifted_by_hand() -> None:
    """Assert that slip is labelled earlier by the shift, and that what is not known stays as it was."""
    label = np.array([-1, -1, 0, 0, 0, 0, 1, 1, 1, -1], np.int8)
    assert shift_labels(label, 0).tolist() == label.tolist()
    assert shift_labels(label, 2).tolist() == [-1, -1, 0, 0, 1, 1, 1, 1, 1, -1]
    assert shift_labels(label, 50).tolist() == label.tolist()
    assert shift_labels(label[:0], 3).tolist() == []
    with pytest.raises(ValueError, match="at least 0, found -1"):
        shift_labels(label, -1)


@given(onset=st.integers(0, 80), horizon_ms=st.integers(0, 30), after=st.integers(1, 40), start=st.integers(0, 40))
def test_shift_moves_the_onset_alone(onset: int, horizon_ms: int, after: int, start: int) -> None:
    """Assert that of labels with one onset, it comes ahead by the shift, as far as slices are examined."""
    slices = np.arange(120)
    label = np.where(slices < start, -1, np.where(slices < onset, 0, 1)).astype(np.int8)
    label[onset + after :] = -1
    shifted = shift_labels(label, horizon_ms)
    np.testing.assert_array_equal(shifted == -1, label == -1)
    expected = (label >= 0) & (slices >= onset - horizon_ms)
    if horizon_ms <= after:  # else the labels end before slices that far ahead of slip see it
        np.testing.assert_array_equal(shifted == 1, expected | (label == 1))
