"""Arrays that lie on disk while they are used: the same as in memory, gone with them, errors in words."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip import features, inputs
from evetac_cli.stages.slip_detectors import join_on_disk
from evetac_cli.store.hdf5 import disk


def test_columns_are_put_end_to_end(tmp_path: Path) -> None:
    """Assert that every column is what numpy makes of its parts, also of empty ones, and the folder stays empty."""
    rng = np.random.default_rng(0)
    parts = [(rng.random((rows, 3, 2), np.float32)[:, ::-1], np.arange(rows, dtype=np.int8)) for rows in (4, 0, 7)]
    values, numbers = disk.joined_on_disk(tmp_path, iter(parts))
    np.testing.assert_array_equal(values, np.concatenate([part[0] for part in parts]))
    np.testing.assert_array_equal(numbers, np.concatenate([part[1] for part in parts]))
    assert (values.dtype, numbers.dtype) == (np.float32, np.int8)
    assert not values.flags.writeable
    assert list(tmp_path.iterdir()) == []
    assert disk.joined_on_disk(tmp_path, []) == ()
    (nothing,) = disk.joined_on_disk(tmp_path, [(np.empty((0, 5), np.int64),)])
    assert (nothing.shape, nothing.dtype) == ((0, 5), np.int64)


def test_a_disk_that_does_not_take_them(tmp_path: Path) -> None:
    """Assert that a folder that is not there is said in words."""
    with pytest.raises(InputError, match="cannot be written: No such file"):
        disk.joined_on_disk(tmp_path / "none", [(np.zeros(3),)])


def test_series_are_the_same_as_in_memory(tmp_path: Path) -> None:
    """Assert that dots and event images are joined on disk to what they are joined to in memory."""
    rng = np.random.default_rng(1)
    dots = [rng.random((rows, 56, 4), np.float32) for rows in (30, 20)]
    on_disk = join_on_disk(tmp_path, dots)
    assert isinstance(on_disk, np.ndarray)
    np.testing.assert_array_equal(on_disk, inputs.join(dots))
    images = []
    for slices in (3, 5):
        start = np.cumsum([0, *rng.integers(0, 9, slices)])
        pixel, sign = np.arange(start[-1], dtype=np.uint32), rng.choice(np.array([-1, 1], np.int8), start[-1])
        images.append(features.EventImages(start, pixel, sign))
    for one, other in zip(join_on_disk(tmp_path, images), features.join_images(images), strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
